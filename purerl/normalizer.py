"""Running mean and variance of a pytree of features, merged batch by batch.

Merging follows Chan, Golub and LeVeque, "Updating formulae and a pairwise algorithm for computing
sample variances" (1979), in terms of the new batch's share f = n_batch / n_total:

    mean     += f * delta                        delta = mean_batch - mean
    variance += f * (variance_batch - variance) + f * (1 - f) * delta^2

which never forms a growing sum. Both additions are compensated (Kahan), because after 1e9
samples an increment is smaller than the last bit of the mean. The count is an exact 64-bit one.
"""

import jax
import jax.numpy as jnp
from flax import struct

from purerl.types import Array, Counter, PyTree, add_count, count_as_float, zero_count

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


def update(statistics: Statistics, batch: PyTree, valid: Array) -> Statistics:
    """Merges `batch` (leaves [..., O]) where `valid` ([...] bool) into the statistics."""
    number = valid.sum(dtype=jnp.uint32)
    count = add_count(statistics.count, number)
    share = number.astype(jnp.float32) / jnp.maximum(count_as_float(count), 1.0)
    merged = jax.tree.map(
        lambda x, mean, variance: _merge(x, valid, share, mean, variance),
        batch,
        statistics.mean,
        statistics.variance,
    )
    mean = jax.tree.map(lambda _, pair: pair[0], batch, merged)
    variance = jax.tree.map(lambda _, pair: pair[1], batch, merged)
    return Statistics(count=count, mean=mean, variance=variance)


def _merge(
    x: Array, valid: Array, share: Array, mean: Compensated, variance: Compensated
) -> tuple[Compensated, Compensated]:
    """Merges one leaf `x` [..., O] whose samples make up `share` [] of the new total."""
    axes = tuple(range(valid.ndim))
    mask = jnp.expand_dims(valid, tuple(range(valid.ndim, x.ndim)))
    number = jnp.maximum(valid.sum(dtype=jnp.float32), 1.0)
    # Deviations from the old mean, so that a large offset does not cost precision.
    deviation = jnp.where(mask, x - _like(mean.value, x), 0.0)
    delta = deviation.sum(axes) / number
    spread = jnp.where(mask, jnp.square(deviation - _like(delta, x)), 0.0).sum(axes) / number
    increment = share * (spread - variance.value) + share * (1.0 - share) * jnp.square(delta)
    return _add(mean, share * delta), _add(variance, increment)


def _add(total: Compensated, increment: Array) -> Compensated:
    """Adds with Kahan's compensation: the error of each addition is repaid by the next."""
    repaid = increment - total.error
    value = total.value + repaid
    return Compensated(value=value, error=(value - total.value) - repaid)
