"""What a walker feels of itself: posture and motion in its torso's frame, and forces."""

from typing import Any

import jax.numpy as jnp
import numpy as np

from purerl import Array, PhysicsState, lookup
from purerl.envs.compose import Composed

READINGS = ("xpos", "xmat", "subtree_com", "actuator_force")


def indices(parts: Composed) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Returns where the walker's own joints, without the free one, stand in qpos and in qvel."""
    joints = [lookup.names(parts.model, "joint")[i] for i in parts.joints]
    places = lookup.qpos_indices(parts.model, joints), lookup.qvel_indices(parts.model, joints)
    qpos, qvel = (tuple(x.tolist()) for x in places)
    return qpos, qvel


def felt(
    parts: Composed,
    joints: tuple[int, ...],
    dofs: tuple[int, ...],
    physics: PhysicsState,
    readings: Any,
    action: Array,
) -> list[Array]:
    """Returns the parts of an observation, each [n].

    Args:
      parts: the walker.
      joints: where its joints stand in qpos.
      dofs: where they stand in qvel.
      physics: of the state.
      readings: with `READINGS`.
      action: that led to the state [A].
    """
    torso = parts.torso
    to_body = readings.xmat[torso].T
    ends = readings.xpos[np.array(parts.end_effectors)] - readings.xpos[torso]
    return [
        readings.xpos[torso, 2:],
        readings.xmat[torso].ravel(),
        physics.qpos[jnp.array(joints)],
        to_body @ physics.qvel[:3],
        physics.qvel[3:6],  # MuJoCo keeps a free joint's rotation in the body's own frame
        physics.qvel[jnp.array(dofs)],
        (ends @ to_body.T).ravel(),
        readings.actuator_force,
        physics.act,
        action,
    ]
