"""Mean and variance: of one batch, of the parts of a batch together, and running over batches.

Merging follows Chan, Golub and LeVeque, "Updating formulae and a pairwise algorithm for computing
sample variances" (1979), in terms of the new batch's share f = n_batch / n_total:

    mean     += f * delta                        delta = mean_batch - mean
    variance += f * (variance_batch - variance) + f * (1 - f) * delta^2

which never forms a growing sum. Both additions are compensated (Kahan), because after 1e9
samples an increment is smaller than the last bit of the mean. The count is an exact 64-bit one.

`Statistics` is what runs on from update to update, and part of a checkpoint. `Moments` is of one
batch, and lives for one update.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from flax import struct

from purerl.core.parts import add_in_order
from purerl.core.records import Array, Counter, PyTree, add_count, count_as_float, zero_count

VARIANCE_FLOOR = 1e-8  # a feature that never moved has variance 0; its first movement stays finite
CLIP = 10.0  # beyond ten standard deviations a feature says "far": one outlier cannot dominate


class Compensated(struct.PyTreeNode):
    """A sum and the error that rounding has made in it: the true sum is `value - error`."""

    value: Array  # [O]
    error: Array  # [O]


class Statistics(struct.PyTreeNode):
    """Statistics of a pytree of features; `mean` and `variance` mirror it, a leaf each [O]."""

    count: Counter
    mean: PyTree  # of Compensated
    variance: PyTree  # of Compensated, the population variance


class Moments(NamedTuple):
    """Count, mean and variance of a batch; of V parts of it, each [V, ...]."""

    num_samples: Array  # [] uint32
    mean: PyTree  # [O] of the difference from a reference
    variance: PyTree  # [O] population variance


def init(example: PyTree) -> Statistics:
    """Returns statistics of nothing (mean 0, variance 1) for features shaped like `example` [O]."""

    example = _measured(example)

    def full(value: float) -> PyTree:
        fill = jnp.full_like
        return jax.tree.map(lambda x: Compensated(fill(x, value), jnp.zeros_like(x)), example)

    # With count 0 the first batch has the share 1: it replaces these numbers, and mixes with none.
    return Statistics(count=zero_count(), mean=full(0.0), variance=full(1.0))


def _measured(features: PyTree) -> PyTree:
    """Returns features without pictures (uint8), which have no statistics: their scale is known."""
    return jax.tree.map(lambda x: None if x.dtype == jnp.uint8 else x, features)


def normalize(statistics: Statistics, features: PyTree) -> PyTree:
    """Returns (features - mean) / std, clipped to +-10; of pictures -1 to 1. Leaves [..., O].

    Args:
      statistics: of the features, leaves [O], unbatched.
      features: leaves [..., O], any leading batch axes.
    """

    def one(x: Array, mean: Compensated | None, variance: Any) -> Array:
        if mean is None:
            return x.astype(jnp.float32) / 127.5 - 1.0
        # The factor is computed at size [O], before it meets the batch.
        factor = jax.lax.rsqrt(variance.value + VARIANCE_FLOOR)
        scaled = (x - _like(mean.value, x)) * _like(factor, x)
        return jnp.clip(scaled, -CLIP, CLIP)

    return jax.tree.map(one, features, statistics.mean, statistics.variance)


def _like(feature: Array, x: Array) -> Array:
    """Returns `feature` [O] with leading axes of size 1 to match `x` [..., O]."""
    return jnp.expand_dims(feature, tuple(range(x.ndim - feature.ndim)))


def deviations(statistics: Statistics, batch: PyTree, valid: Array) -> Moments:
    """Returns the moments of a batch, its mean less the running one: what `merge` takes.

    Args:
      statistics: the running ones, leaves [O], unbatched.
      batch: leaves [..., O].
      valid: [...] bool: which samples count.
    """
    batch = _measured(batch)
    reference = jax.tree.map(lambda x, mean: mean.value, batch, statistics.mean)
    return moments_of(batch, valid, reference)


def moments_of(batch: PyTree, valid: Array, reference: PyTree = None) -> Moments:
    """Returns the moments of a batch.

    Args:
      batch: leaves [..., O].
      valid: [...] bool: which samples count; of none of them, mean and variance are 0.
      reference: leaves [O] near the mean, so that a large offset does not cost precision; it is
        subtracted from the mean that is returned. None: 0.
    """
    if reference is None:
        reference = jax.tree.map(lambda x: jnp.zeros(x.shape[valid.ndim :]), batch)
    pairs = jax.tree.map(lambda x, near: _moments_of_leaf(x, valid, near), batch, reference)
    mean = jax.tree.map(lambda _, pair: pair[0], batch, pairs)
    variance = jax.tree.map(lambda _, pair: pair[1], batch, pairs)
    return Moments(valid.sum(dtype=jnp.uint32), mean, variance)


def _moments_of_leaf(x: Array, valid: Array, reference: Array) -> tuple[Array, Array]:
    """Returns mean (less the reference) and variance [O] of one leaf.

    Args:
      x: [..., O].
      valid: [...] bool.
      reference: [O].
    """
    axes = tuple(range(valid.ndim))
    mask = jnp.expand_dims(valid, tuple(range(valid.ndim, x.ndim)))
    count = jnp.maximum(valid.sum(dtype=jnp.float32), 1.0)
    # `where`, not a product: an invalid sample may be NaN, and 0 times NaN is NaN.
    deviation = jnp.where(mask, x - _like(reference, x), 0.0)
    mean = deviation.sum(axes) / count
    # Two passes. E[x^2] - E[x]^2 would cancel where the mean is large beside the deviation.
    spread = jnp.where(mask, jnp.square(deviation - _like(mean, x)), 0.0).sum(axes) / count
    return mean, spread


def pool(each: Moments) -> Moments:
    """Returns the moments of V parts together, [...], from those of each, [V, ...]."""
    count = add_in_order(each.num_samples)
    whole = jnp.maximum(count.astype(jnp.float32), 1.0)
    share = each.num_samples.astype(jnp.float32) / whole[None]

    def average(x: Array) -> Array:
        return add_in_order(jnp.expand_dims(share, tuple(range(share.ndim, x.ndim))) * x)

    # The law of total variance: the mean of the variances, and the variance of the means.
    def spread(variance: Array, mean: Array, whole_mean: Array) -> Array:
        return average(variance + jnp.square(mean - whole_mean[None]))

    mean = jax.tree.map(average, each.mean)
    return Moments(count, mean, jax.tree.map(spread, each.variance, each.mean, mean))


def merge(statistics: Statistics, batch: Moments) -> Statistics:
    """Merges a batch into the statistics, by the equations at the top of this module.

    Args:
      statistics: the running ones, leaves [O].
      batch: its `deviations` from these very statistics, leaves [O]: their mean is delta.
    """
    count = add_count(statistics.count, batch.num_samples)
    # An empty batch has the share 0 and changes nothing; the maximum is for an empty first one.
    share = batch.num_samples.astype(jnp.float32) / jnp.maximum(count_as_float(count), 1.0)
    mean = jax.tree.map(lambda delta, mean: _add(mean, share * delta), batch.mean, statistics.mean)

    def moved(delta: Array, spread: Array, variance: Compensated) -> Compensated:
        within = share * (spread - variance.value)
        return _add(variance, within + share * (1.0 - share) * jnp.square(delta))

    variance = jax.tree.map(moved, batch.mean, batch.variance, statistics.variance)
    return Statistics(count=count, mean=mean, variance=variance)


def _add(total: Compensated, increment: Array) -> Compensated:
    """Adds with Kahan's compensation: the error of each addition is repaid by the next.

    Args:
      total: [O] the sum so far.
      increment: [O].
    """
    repaid = increment - total.error
    value = total.value + repaid
    # In exact arithmetic the error is 0. XLA does not simplify it away, for it keeps to the order
    # in which floating-point numbers are added.
    return Compensated(value=value, error=(value - total.value) - repaid)
