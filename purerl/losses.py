"""The PPO objective (Schulman et al. 2017, arXiv:1707.06347), as functions of plain arrays.

Every mean is weighted: `weight` is 1 for a sound sample and 0 for one whose physics blew up.
"""

import jax.numpy as jnp

from purerl.types import Array


def weighted_mean(x: Array, weight: Array) -> Array:
    """Returns sum(weight * x) / sum(weight), [], over all axes; 0 where all weights are 0."""
    return (weight * x).sum() / jnp.maximum(weight.sum(), 1.0)


def normalize_advantage(advantage: Array, weight: Array) -> Array:
    """Returns the advantage with weighted mean 0 and standard deviation 1, same shape."""
    mean = weighted_mean(advantage, weight)
    variance = weighted_mean(jnp.square(advantage - mean), weight)
    return (advantage - mean) / (jnp.sqrt(variance) + 1e-8)


def clipped_surrogate(log_ratio: Array, advantage: Array, clip: float) -> Array:
    """Returns -min(r A, clip(r, 1 - c, 1 + c) A), elementwise, r = exp(log_ratio) (equation 7)."""
    ratio = jnp.exp(log_ratio)
    clipped = jnp.clip(ratio, 1.0 - clip, 1.0 + clip)
    return -jnp.minimum(ratio * advantage, clipped * advantage)


def value_loss(value: Array, old_value: Array, target: Array, clip: float | None) -> Array:
    """Returns the squared error of the value, elementwise; with `clip`, the pessimistic one.

    Clipped: max((V - G)^2, (V_old + clip(V - V_old, -c, c) - G)^2) / 2, in scaled-reward units.
    """
    error = jnp.square(value - target)
    if clip is not None:
        near = old_value + jnp.clip(value - old_value, -clip, clip)
        error = jnp.maximum(error, jnp.square(near - target))
    return 0.5 * error


def approximate_kl(log_ratio: Array) -> Array:
    """Returns (r - 1) - log r, elementwise: an unbiased, never negative estimate of KL(old, new).

    Schulman, "Approximating KL divergence" (2020), the estimator k3.
    """
    return jnp.expm1(log_ratio) - log_ratio


def explained_variance(value: Array, target: Array, weight: Array) -> Array:
    """Returns 1 - Var(target - value) / Var(target), []: 1 is perfect, 0 no better than a mean."""
    residual = target - value
    unexplained = weighted_mean(jnp.square(residual - weighted_mean(residual, weight)), weight)
    total = weighted_mean(jnp.square(target - weighted_mean(target, weight)), weight)
    return 1.0 - unexplained / jnp.maximum(total, 1e-8)
