"""The PPO objective (Schulman et al. 2017, arXiv:1707.06347), as functions of plain arrays.

Every mean is weighted: `weight` is 1 for a sound sample and 0 for one whose physics blew up.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from purerl.core.records import Array
from purerl.devices.shards import WHOLE, Shards, add_in_order, from_all


class Scale(NamedTuple):
    """What the parts of a minibatch must agree on."""

    weight: Array  # [] sum of the weights, at least 1; of K minibatches [K]
    mean: Array  # [] of the advantages
    std: Array  # []


def weighted_mean(x: Array, weight: Array) -> Array:
    """Returns sum(weight * x) / sum(weight), [], over all axes; 0 where all weights are 0."""
    return (weight * x).sum() / jnp.maximum(weight.sum(), 1.0)


def weighted_moments(
    x: Array, weight: Array, shards: Shards = WHOLE, several: bool = False
) -> tuple[Array, Array, Array]:
    """Returns sum(weight), at least 1, weighted mean and variance of `x`, [] each, over all axes.

    Of `several` batches, [K, ...], those of each, [K]. Shards' own means and squares are put
    together as in `normalizer.pool`: one message.
    """

    def sums(x: Array, w: Array) -> tuple[Array, Array, Array]:
        number, whole = w.sum(), (w * x).sum()
        mean = whole / jnp.maximum(number, 1.0)
        return number, whole, (w * jnp.square(x - mean)).sum()

    of_each = jax.vmap(sums) if several else sums
    numbers, wholes, squares = from_all(shards, of_each, x, weight)
    number = jnp.maximum(add_in_order(numbers), 1.0)
    mean = add_in_order(wholes) / number
    apart = wholes / jnp.maximum(numbers, 1.0) - mean[None]
    return number, mean, add_in_order(squares + numbers * jnp.square(apart)) / number


def advantage_scale(
    advantage: Array, weight: Array, shards: Shards = WHOLE, several: bool = False
) -> Scale:
    """Returns mean and deviation of a minibatch's advantages, or of `several` minibatches', [K]."""
    number, mean, variance = weighted_moments(advantage, weight, shards, several)
    return Scale(weight=number, mean=mean, std=jnp.sqrt(variance))


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
    _, _, unexplained = weighted_moments(target - value, weight, shards)
    _, _, variance = weighted_moments(target, weight, shards)
    return 1.0 - unexplained / jnp.maximum(variance, 1e-8)
