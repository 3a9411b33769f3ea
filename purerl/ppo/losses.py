"""The PPO objective (Schulman et al. 2017, arXiv:1707.06347), as functions of plain arrays.

Every mean is weighted: `weight` is 1 for a sound sample and 0 for one whose physics blew up.
"""

import math

import jax.numpy as jnp

from purerl.core.parts import Parts
from purerl.core.records import Array
from purerl.ppo.running_moments import Moments, moments, pool


def normalize_advantage(advantage: Array, scale: Moments, least: float, clip: float) -> Array:
    """Returns the advantage less its mean, over its deviation, or `least` if that is more.

    By a minibatch's moments []; then clipped to +- `clip` unless that is 0. One failure among M
    alike samples is sqrt(M) deviations away; the ratio's clip does not hold a negative one.
    """
    deviation = jnp.sqrt(scale.variance) + 1e-8
    normalized = (advantage - scale.mean) / (jnp.maximum(deviation, least) if least else deviation)
    return jnp.clip(normalized, -clip, clip) if clip else normalized


def clipped_surrogate(log_ratio: Array, advantage: Array, clip: float) -> Array:
    """Returns -min(r A, clip(r, 1 - c, 1 + c) A), elementwise, r = exp(log_ratio) (equation 7)."""
    ratio = jnp.exp(log_ratio)
    clipped = jnp.clip(ratio, 1.0 - clip, 1.0 + clip)
    return -jnp.minimum(ratio * advantage, clipped * advantage)


def value_loss(value: Array, target: Array) -> Array:
    """Returns (V - G)^2 / 2, elementwise."""
    return 0.5 * jnp.square(value - target)


def bounded_entropy(entropy: Array, action_size: int, target: float) -> Array:
    """Returns the mean entropy of an action [nats], at most `target`, elementwise."""
    mean = entropy / action_size  # a sum would outweigh what one action of many can earn
    return mean if target >= math.log(2.0) else jnp.minimum(mean, target)  # log 2: uniform actions


def approximate_kl(log_ratio: Array) -> Array:
    """Returns (r - 1) - log r, elementwise: an unbiased, never negative estimate of KL(old, new).

    Schulman, "Approximating KL divergence" (2020), the estimator k3.
    """
    return jnp.expm1(log_ratio) - log_ratio


def explained_variance(value: Array, target: Array, weight: Array, parts: Parts) -> Array:
    """Returns 1 - Var(target - value) / Var(target), [], of V parts [V, ...]; 1 is perfect."""

    def both(value: Array, target: Array, weight: Array) -> Moments:
        return moments({"error": target - value, "target": target}, weight > 0)

    variance = pool(parts.gather(parts.map(both, value, target, weight))).variance
    return 1.0 - variance["error"] / jnp.maximum(variance["target"], 1e-8)
