"""The PPO objective (Schulman et al. 2017, arXiv:1707.06347), as functions of plain arrays.

Every mean is weighted: `weight` is 1 for a sound sample and 0 for one whose physics blew up.
"""

from typing import NamedTuple

import jax.numpy as jnp

from purerl.shards import WHOLE, Shards, total
from purerl.types import Array


class Scale(NamedTuple):
    """What the parts of a minibatch must agree on."""

    weight: Array  # [] sum of the weights, at least 1
    mean: Array  # [] of the advantages
    std: Array  # []


def weighted_mean(x: Array, weight: Array, shards: Shards = WHOLE) -> Array:
    """Returns sum(weight * x) / sum(weight), [], over all axes; 0 where all weights are 0."""
    whole, weights = total(shards, lambda x, w: ((w * x).sum(), w.sum()), x, weight)
    return whole / jnp.maximum(weights, 1.0)


def weighted_variance(x: Array, weight: Array, mean: Array, shards: Shards = WHOLE) -> Array:
    """Returns the weighted mean of (x - mean)^2, [], over all axes."""

    def sums(x: Array, w: Array) -> tuple[Array, Array]:
        return (w * jnp.square(x - mean)).sum(), w.sum()

    whole, weights = total(shards, sums, x, weight)
    return whole / jnp.maximum(weights, 1.0)


def advantage_scale(advantage: Array, weight: Array, shards: Shards = WHOLE) -> Scale:
    """Returns weighted mean and standard deviation of a minibatch's advantages."""
    whole, weights = total(shards, lambda x, w: ((w * x).sum(), w.sum()), advantage, weight)
    weights = jnp.maximum(weights, 1.0)
    mean = whole / weights
    squares = total(shards, lambda x, w: (w * jnp.square(x - mean)).sum(), advantage, weight)
    return Scale(weight=weights, mean=mean, std=jnp.sqrt(squares / weights))


def normalize_advantage(advantage: Array, scale: Scale) -> Array:
    """Returns the advantage with weighted mean 0 and standard deviation 1, same shape."""
    return (advantage - scale.mean) / (scale.std + 1e-8)


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


def explained_variance(value: Array, target: Array, weight: Array, shards: Shards = WHOLE) -> Array:
    """Returns 1 - Var(target - value) / Var(target), []: 1 is perfect, 0 no better than a mean."""
    residual = target - value
    mean = weighted_mean(residual, weight, shards)
    unexplained = weighted_variance(residual, weight, mean, shards)
    mean = weighted_mean(target, weight, shards)
    return 1.0 - unexplained / jnp.maximum(weighted_variance(target, weight, mean, shards), 1e-8)
