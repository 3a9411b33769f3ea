"""Running mean and variance of a pytree of features, merged batch by batch.

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

from purerl.core.records import Array, Counter, PyTree, add_count, count_as_float, zero_count
from purerl.devices.shards import add_in_order

# A feature that never moved has variance 0; the floor keeps its first movement finite.
VARIANCE_FLOOR = 1e-8
# Beyond ten standard deviations a feature says "far" and no more: one outlier cannot dominate.
CLIP = 10.0


class Compensated(struct.PyTreeNode):
    """A sum and what rounding has taken from it."""

    value: Array  # [...]
    error: Array  # [...]


class Statistics(struct.PyTreeNode):
    """Statistics of a pytree of features; `mean` and `variance` mirror it, a leaf each [O]."""

    count: Counter
    mean: PyTree  # of Compensated
    variance: PyTree  # of Compensated, the population variance


def init(example: PyTree) -> Statistics:
    """Returns statistics of nothing (mean 0, variance 1) for features shaped like `example`."""
    zeros = jax.tree.map(lambda x: Compensated(jnp.zeros(x.shape), jnp.zeros(x.shape)), example)
    ones = jax.tree.map(lambda x: Compensated(jnp.ones(x.shape), jnp.zeros(x.shape)), example)
    return Statistics(count=zero_count(), mean=zeros, variance=ones)


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


class Moments(NamedTuple):
    """What a batch adds to statistics; of V shards [V, ...]."""

    number: Array  # [] uint32 samples
    delta: PyTree  # [O] mean of the batch, less that of the statistics
    spread: PyTree  # [O] population variance of the batch


def update(statistics: Statistics, batch: PyTree, valid: Array) -> Statistics:
    """Merges `batch` (leaves [..., O]) where `valid` ([...] bool) into the statistics."""
    return merge(statistics, moments(statistics, batch, valid))


def moments(statistics: Statistics, batch: PyTree, valid: Array) -> Moments:
    """Returns the moments of `batch` (leaves [..., O]) where `valid` ([...] bool)."""
    pairs = jax.tree.map(lambda x, mean: _moments(x, valid, mean), batch, statistics.mean)
    delta = jax.tree.map(lambda _, pair: pair[0], batch, pairs)
    spread = jax.tree.map(lambda _, pair: pair[1], batch, pairs)
    return Moments(valid.sum(dtype=jnp.uint32), delta, spread)


def _moments(x: Array, valid: Array, mean: Compensated) -> tuple[Array, Array]:
    """Returns mean (less the old one) and variance [O] of one leaf `x` [..., O]."""
    axes = tuple(range(valid.ndim))
    mask = jnp.expand_dims(valid, tuple(range(valid.ndim, x.ndim)))
    number = jnp.maximum(valid.sum(dtype=jnp.float32), 1.0)
    # Deviations from the old mean, so that a large offset does not cost precision.
    deviation = jnp.where(mask, x - _like(mean.value, x), 0.0)
    delta = deviation.sum(axes) / number
    spread = jnp.where(mask, jnp.square(deviation - _like(delta, x)), 0.0).sum(axes) / number
    return delta, spread


def pool(parts: Moments) -> Moments:
    """Returns the moments of V shards together, from those of each [V, ...], in their order."""
    number = add_in_order(parts.number)
    share = parts.number.astype(jnp.float32) / jnp.maximum(number.astype(jnp.float32), 1.0)

    def mean(x: Array) -> Array:
        return add_in_order(jnp.expand_dims(share, tuple(range(1, x.ndim))) * x)

    delta = jax.tree.map(mean, parts.delta)
    spread = jax.tree.map(
        lambda s, d, whole: mean(s + jnp.square(d - _like(whole, d))),
        parts.spread,
        parts.delta,
        delta,
    )
    return Moments(number, delta, spread)


def merge(statistics: Statistics, batch: Moments) -> Statistics:
    """Merges a batch into the statistics."""
    count = add_count(statistics.count, batch.number)
    share = batch.number.astype(jnp.float32) / jnp.maximum(count_as_float(count), 1.0)
    mean = jax.tree.map(lambda delta, mean: _add(mean, share * delta), batch.delta, statistics.mean)
    variance = jax.tree.map(
        lambda delta, spread, variance: _add(
            variance,
            share * (spread - variance.value) + share * (1.0 - share) * jnp.square(delta),
        ),
        batch.delta,
        batch.spread,
        statistics.variance,
    )
    return Statistics(count=count, mean=mean, variance=variance)


def _add(total: Compensated, increment: Array) -> Compensated:
    """Adds with Kahan's compensation: the error of each addition is repaid by the next."""
    repaid = increment - total.error
    value = total.value + repaid
    return Compensated(value=value, error=(value - total.value) - repaid)
