"""What differs between episodes: how a walker stands; factors on friction, masses, strength."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp

from purerl import Array
from purerl.envs.compose import Composed


@dataclasses.dataclass(frozen=True)
class Randomization:
    """Factors on the model's own values, uniform once an episode; (1, 1) changes nothing."""

    friction: tuple[float, float] = (1.0, 1.0)
    """Sliding friction of every geom."""
    mass: tuple[float, float] = (1.0, 1.0)
    """Mass and inertia of every body, by one factor."""
    gear: tuple[float, float] = (1.0, 1.0)
    """Strength of every actuator, by one factor."""

    def __post_init__(self):
        """Refuses ranges that make no sense."""
        for name in ("friction", "mass", "gear"):
            low, high = getattr(self, name)
            if not 0.0 < low <= high:
                raise ValueError(f"{name} is {(low, high)}; give factors 0 < least <= greatest.")


def draw_stance(
    limbs_key: Array, velocity_key: Array, parts: Composed, noise: float
) -> tuple[Array, Array]:
    """Draws qpos [nq] and qvel [nv] of a walker that stands: joints and velocities around rest.

    Args:
      limbs_key: of its joints.
      velocity_key: of all velocities.
      parts: the walker.
      noise: half-width of what is drawn [rad, m/s, rad/s].
    """
    limbs = jax.random.uniform(limbs_key, (len(parts.qpos),), minval=-noise, maxval=noise)
    qvel = jax.random.uniform(velocity_key, (parts.model.nv,), minval=-noise, maxval=noise)
    rest = jnp.asarray(parts.model.qpos0, jnp.float32)
    # Unique: a sum of terms that might meet would have no fixed order on a GPU.
    return rest.at[jnp.array(parts.qpos)].add(limbs, unique_indices=True), qvel


def draw_factors(key: Array, randomization: Randomization) -> dict[str, Array]:
    """Draws an episode's factors, name -> [], for the ranges that leave a choice."""
    factors = {}
    for number, (name, (low, high)) in enumerate(dataclasses.asdict(randomization).items()):
        if low < high:
            # By number, so that switching one range on leaves the other draws as they are.
            draw = jax.random.fold_in(key, number)
            factors[name] = jax.random.uniform(draw, (), minval=low, maxval=high)
        elif low != 1.0:
            factors[name] = jnp.asarray(low, jnp.float32)
    return factors


def randomized_fields(model: Any, factors: dict[str, Array]) -> dict[str, Array]:
    """Returns the model fields that an episode's factors change."""
    fields = {
        "friction": ("geom_friction",),
        "mass": ("body_mass", "body_inertia"),
        "gear": ("actuator_gear",),
    }
    changes = {}
    for name, factor in factors.items():
        for field in fields[name]:
            own = jnp.asarray(getattr(model, field), jnp.float32)
            if name == "friction":  # of its three numbers only the first slides
                changes[field] = own.at[:, 0].multiply(factor)
            else:
                changes[field] = own * factor
    return changes
