"""Mean and variance: of one batch, of the parts of a batch together, and running over batches.

Merging follows Chan, Golub and LeVeque, "Updating formulae and a pairwise algorithm for computing
sample variances" (1979), in terms of the new batch's share f = n_batch / n_total:

    mean     += f * delta                        delta = mean_batch - mean
    variance += f * (variance_batch - variance) + f * (1 - f) * delta^2

which never forms a growing sum. Both additions are compensated (Kahan), because after 1e9
samples an increment is smaller than the last bit of the mean. The count is an exact 64-bit one.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from flax import struct

from purerl.core.parts import add_in_order
from purerl.core.records import Array, Counter, PyTree, add_count, count_as_float, zero_count

VARIANCE_FLOOR = 1e-8  # a feature that never moved has variance 0; its first movement stays finite
CLIP = 10.0  # beyond ten standard deviations a feature says "far": one outlier cannot dominate


class Compensated(struct.PyTreeNode):
    """A sum and what rounding has taken from it."""

    value: Array  # [...]
    error: Array  # [...]


class Statistics(struct.PyTreeNode):
    """Statistics of a pytree of features; `mean` and `variance` mirror it, a leaf each [O]."""

    count: Counter
    mean: PyTree  # of Compensated
    variance: PyTree  # of Compensated, the population variance


class Moments(NamedTuple):
    """Mean and variance of a batch; of V parts of it [V, ...]."""

    number: Array  # [] uint32 samples
    mean: PyTree  # [O] of the difference from a reference
    variance: PyTree  # [O] population variance


def init(example: PyTree) -> Statistics:
    """Returns statistics of nothing (mean 0, variance 1) for features shaped like `example`."""

    def full(number: float) -> PyTree:
        fill = jnp.full_like
        return jax.tree.map(lambda x: Compensated(fill(x, number), jnp.zeros_like(x)), example)

    return Statistics(count=zero_count(), mean=full(0.0), variance=full(1.0))


def normalize(statistics: Statistics, features: PyTree) -> PyTree:
    """Returns (features - mean) / std, clipped to +-10; any leading axes, leaves [..., O]."""

    def one(x: Array, mean: Compensated, variance: Compensated) -> Array:
        factor = jax.lax.rsqrt(variance.value + VARIANCE_FLOOR)
        scaled = (x - _like(mean.value, x)) * _like(factor, x)
        return jnp.clip(scaled, -CLIP, CLIP)

    return jax.tree.map(one, features, statistics.mean, statistics.variance)


def _like(feature: Array, x: Array) -> Array:
    """Returns `feature` [O] with leading axes of size 1 to match `x` [..., O]."""
    return jnp.expand_dims(feature, tuple(range(x.ndim - feature.ndim)))


def deviations(statistics: Statistics, batch: PyTree, valid: Array) -> Moments:
    """Returns the moments of `batch` where `valid`, with the running mean as the reference."""
    reference = jax.tree.map(lambda x, mean: mean.value, batch, statistics.mean)
    return moments(batch, valid, reference)


def moments(batch: PyTree, valid: Array, reference: PyTree = None) -> Moments:
    """Returns the moments of a batch.

    Args:
      batch: leaves [..., O].
      valid: [...] bool: which samples count; of none of them, mean and variance are 0.
      reference: leaves [O] near the mean, so that a large offset does not cost precision; or 0.
    """
    if reference is None:
        reference = jax.tree.map(lambda x: jnp.zeros(x.shape[valid.ndim :]), batch)
    pairs = jax.tree.map(lambda x, near: _moments(x, valid, near), batch, reference)
    mean = jax.tree.map(lambda _, pair: pair[0], batch, pairs)
    variance = jax.tree.map(lambda _, pair: pair[1], batch, pairs)
    return Moments(valid.sum(dtype=jnp.uint32), mean, variance)


def _moments(x: Array, valid: Array, reference: Array) -> tuple[Array, Array]:
    """Returns mean (less the reference) and variance [O] of one leaf `x` [..., O]."""
    axes = tuple(range(valid.ndim))
    mask = jnp.expand_dims(valid, tuple(range(valid.ndim, x.ndim)))
    number = jnp.maximum(valid.sum(dtype=jnp.float32), 1.0)
    deviation = jnp.where(mask, x - _like(reference, x), 0.0)
    mean = deviation.sum(axes) / number
    spread = jnp.where(mask, jnp.square(deviation - _like(mean, x)), 0.0).sum(axes) / number
    return mean, spread


def pool(parts: Moments) -> Moments:
    """Returns the moments of V parts together, [...], from those of each, [V, ...]."""
    number = add_in_order(parts.number)
    whole = jnp.maximum(number.astype(jnp.float32), 1.0)
    share = parts.number.astype(jnp.float32) / whole[None]

    def average(x: Array) -> Array:
        return add_in_order(jnp.expand_dims(share, tuple(range(share.ndim, x.ndim))) * x)

    def spread(variance: Array, mean: Array, whole: Array) -> Array:
        return average(variance + jnp.square(mean - whole[None]))

    mean = jax.tree.map(average, parts.mean)
    return Moments(number, mean, jax.tree.map(spread, parts.variance, parts.mean, mean))


def merge(statistics: Statistics, batch: Moments) -> Statistics:
    """Merges the `deviations` of a batch into the statistics."""
    count = add_count(statistics.count, batch.number)
    share = batch.number.astype(jnp.float32) / jnp.maximum(count_as_float(count), 1.0)
    mean = jax.tree.map(lambda delta, mean: _add(mean, share * delta), batch.mean, statistics.mean)
    variance = jax.tree.map(
        lambda delta, spread, variance: _add(
            variance, share * (spread - variance.value) + share * (1.0 - share) * jnp.square(delta)
        ),
        batch.mean,
        batch.variance,
        statistics.variance,
    )
    return Statistics(count=count, mean=mean, variance=variance)


def _add(total: Compensated, increment: Array) -> Compensated:
    """Adds with Kahan's compensation: the error of each addition is repaid by the next."""
    repaid = increment - total.error
    value = total.value + repaid
    return Compensated(value=value, error=(value - total.value) - repaid)
