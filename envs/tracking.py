"""How near a body is to a recording: errors, the terms of a reward, what is to come. All pure.

Places are in the world, [m], and turns quaternions with w first; what the policy is told is in the
body's own frame, so that it does not depend on where the recording is or which way it heads.
"""

from dataclasses import dataclass, field
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from purerl import Array


class Pose(NamedTuple):
    """A body, or a recording's frames [...]: J joints, B of its parts."""

    place: Array  # [..., 3] of the torso [m]
    turn: Array  # [..., 4] of the torso
    joints: Array  # [..., J] [rad, or m]
    speeds: Array  # [..., J] of the joints [rad/s, or m/s]
    bodies: Array  # [..., B, 3] [m]


class Effort(NamedTuple):
    """What a step cost."""

    action: Array  # [A]
    before: Array  # [A] the action of the step before
    qvel: Array  # [nv] after the step [m/s, rad/s]
    forces: Array  # [nv] of the actuators [N, N m]


@dataclass(frozen=True)
class Term:
    """One term of the reward: weight * exp(-(error / scale)^2 / 2); of weight 0 it is left out."""

    weight: float = 1.0
    """What no error earns, per control step."""
    scale: float = 1.0
    """The error that earns exp(-1/2) = 61% of it."""

    def __post_init__(self) -> None:
        """Refuses a scale that makes no sense."""
        if not self.scale > 0.0:
            raise ValueError(f"scale is {self.scale}; give an error above 0.")


def _term(weight: float, scale: float):
    return field(default_factory=lambda: Term(weight, scale))


@dataclass(frozen=True)
class Reward:
    """Weights and scales; as they stand, those of a rat of 0.2 m."""

    root_position: Term = _term(1.0, 0.035)
    """How far the torso is from the recording's [m]."""
    root_rotation: Term = _term(1.0, 80.0)
    """By which angle it is turned from it, 0 to 180 [deg]."""
    joints: Term = _term(1.0, 1.41)
    """Root of the sum of squares over all joints [rad]."""
    joint_velocities: Term = _term(0.0, 10.0)
    """The same of their velocities [rad/s]."""
    body_positions: Term = _term(0.0, 0.25)
    """Root of the sum of squares over all bodies' distances [m]."""
    end_effectors: Term = _term(1.0, 0.03)
    """The same of where the limbs end [m]."""
    height_weight: float = 1.0
    """Reward while the torso is within `height`."""
    height: tuple[float, float] = (0.0325, 0.5)
    """Of the torso above the floor, least and greatest [m]."""
    control_weight: float = 0.02
    """Reward taken for the sum of squared actions."""
    change_weight: float = 0.02
    """Reward taken for the sum of squared changes of the action."""
    energy_weight: float = 0.01
    """Reward taken for the actuators' power, the sum of each joint's without its sign [W]."""
    most_energy: float = 50.0
    """More power than this costs no more [W]."""


def conjugate(quat: Array) -> Array:
    """Returns the opposite turn of a quaternion [..., 4]."""
    return quat * jnp.array([1.0, -1.0, -1.0, -1.0])


def product(one: Array, other: Array) -> Array:
    """Returns the product of quaternions [..., 4]: the turn by `other`, then by `one`."""
    w, x, y, z = (one[..., i] for i in range(4))
    a, b, c, d = (other[..., i] for i in range(4))
    parts = (
        w * a - x * b - y * c - z * d,
        w * b + x * a + y * d - z * c,
        w * c - x * d + y * a + z * b,
        w * d + x * c - y * b + z * a,
    )
    return jnp.stack(parts, axis=-1)


def into_frame(turn: Array, vector: Array) -> Array:
    """Returns vectors [..., 3] of the world as a frame with this turn [4] has them: R^T v."""
    w, axis = turn[0], turn[1:]
    cross = jnp.cross(vector, axis)
    return vector + 2.0 * (w * cross + jnp.cross(cross, axis))


def angle(one: Array, other: Array) -> Array:
    """Returns the whole angle between turns [..., 4], 0 to 180 [deg]."""
    apart = product(conjugate(one), other)
    sine = jnp.sqrt(jnp.square(apart[..., 1:]).sum(-1))
    return jnp.rad2deg(2.0 * jnp.arctan2(sine, jnp.abs(apart[..., 0])))


def norm(x: Array) -> Array:
    """Returns the root of the sum of all squares, []."""
    return jnp.sqrt(jnp.square(x).sum())


def errors(now: Pose, reference: Pose, ends: np.ndarray) -> dict[str, Array]:
    """Returns how far a body is from a frame, [] each, in the units of `Reward`.

    Args:
      now: of the body, unbatched.
      reference: the frame.
      ends: which of the bodies are where limbs end, int.
    """
    away = now.bodies - reference.bodies
    return {
        "root_position": norm(now.place - reference.place),
        "root_rotation": angle(now.turn, reference.turn),
        "joints": norm(now.joints - reference.joints),
        "joint_velocities": norm(now.speeds - reference.speeds),
        "body_positions": norm(away),
        "end_effectors": norm(away[ends]),
    }


def readable(now: Pose, reference: Pose) -> dict[str, Array]:
    """Returns the same for people, [] each: means over joints [deg] and bodies [mm]."""
    away = jnp.sqrt(jnp.square(now.bodies - reference.bodies).sum(-1))
    return {
        "root_error": 1e3 * norm(now.place - reference.place),
        "angle_error": angle(now.turn, reference.turn),
        "joint_error": jnp.rad2deg(jnp.abs(now.joints - reference.joints).mean()),
        "body_error": 1e3 * away.mean(),
    }


def reward_terms(reward: Reward, apart: dict[str, Array], height: Array, effort: Effort) -> dict:
    """Returns the reward as its terms, name -> []; those of weight 0 are left out.

    Args:
      reward: weights and scales.
      apart: of `errors`.
      height: of the torso, [] [m].
      effort: what the step cost.
    """
    low, high = reward.height
    power = jnp.abs(effort.qvel * effort.forces).sum()
    terms = {
        name: (getattr(reward, name).weight, near(reward, name, x)) for name, x in apart.items()
    }
    terms |= {
        "height": (reward.height_weight, ((height >= low) & (height <= high)).astype(jnp.float32)),
        "control": (-reward.control_weight, jnp.square(effort.action).sum()),
        "change": (-reward.change_weight, jnp.square(effort.action - effort.before).sum()),
        "energy": (-reward.energy_weight, jnp.minimum(power, reward.most_energy)),
    }
    return {name: weight * value for name, (weight, value) in terms.items() if weight}


def near(reward: Reward, name: str, error: Array) -> Array:
    """Returns 1 for no error, and less the farther it is, []."""
    return jnp.exp(-0.5 * jnp.square(error / getattr(reward, name).scale))


def targets(now: Pose, coming: Pose) -> Array:
    """Returns what is to come, from where the body is and as it is turned, [W * (7 + J + 3 B)].

    Of each frame: how far ahead, aside and above its torso is [3], by which turn [4], by how much
    each joint is to move [J], and how far each part of the body is from where it is now [3 B].

    Args:
      now: of the body, unbatched.
      coming: W frames.
    """
    turn = product(conjugate(now.turn), coming.turn)
    turn = jnp.where(turn[:, :1] < 0.0, -turn, turn)  # both signs are one turn: one of them
    parts = (
        into_frame(now.turn, coming.place - now.place),
        turn,
        coming.joints - now.joints,
        into_frame(now.turn, coming.bodies - now.bodies).reshape(len(turn), -1),
    )
    return jnp.concatenate(parts, axis=-1).ravel()
