"""What a walker feels of itself: posture and motion in its torso's frame, and forces."""

from typing import Any

import jax.numpy as jnp
import numpy as np

from purerl import Array, PhysicsState
from purerl.envs.compose import Composed

READINGS = ("xpos", "xmat", "subtree_com", "actuator_force")


def felt(parts: Composed, physics: PhysicsState, readings: Any, action: Array) -> list[Array]:
    """Returns the parts of an observation, each [n].

    Args:
      parts: the walker.
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
        physics.qpos[jnp.array(parts.qpos)],
        to_body @ physics.qvel[:3],
        physics.qvel[3:6],  # MuJoCo keeps a free joint's rotation in the body's own frame
        physics.qvel[jnp.array(parts.qvel)],
        (ends @ to_body.T).ravel(),
        readings.actuator_force,
        physics.act,
        action,
    ]
