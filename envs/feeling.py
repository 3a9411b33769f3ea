"""What a walker feels of itself: posture and motion in its torso's frame, and forces."""

from typing import Any

import jax.numpy as jnp
import numpy as np

from purerl import Array, PhysicsState
from purerl.envs import tracking
from purerl.envs.body_parts import Parts
from purerl.envs.compose import Composed
from purerl.envs.tracking import Pose

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


def proprioception(
    parts: Parts, now: Pose, physics: PhysicsState, readings: Any, action: Array
) -> Array:
    """Returns what a body feels of itself, [P]: nothing of where it is, or which way it heads.

    Angles and velocities of its joints, forces of its actuators (a free joint's six zeros too, as
    track-mjx lays a rodent's out), its height [m], which way is up, where its limbs end as seen
    from the torso [m], its sensors, and the action before.
    """
    ends = now.bodies[np.array(parts.ends)] - now.place
    told = [
        now.joints,
        now.speeds,
        readings.qfrc_actuator[np.array(parts.dofs)],
        now.place[2:],
        readings.xmat[parts.torso][2],  # the world's z as the torso has it
        tracking.into_frame(now.turn, ends).ravel(),
    ]
    if parts.sensors:
        told.append(readings.sensordata[np.array(parts.sensors)])
    if parts.free:  # MuJoCo keeps a free joint's rotation in the body's own frame
        moving = physics.qvel[np.array(parts.free)]
        told += [tracking.into_frame(now.turn, moving[:3]), moving[3:]]
    return jnp.concatenate([*told, action])
