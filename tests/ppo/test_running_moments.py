"""Running statistics against float64 numpy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from purerl.core.records import count_as_int, zero_count
from purerl.ppo import running_moments


def update(statistics, batch, valid):
    """Merges a batch into statistics, as an update does."""
    return running_moments.merge(statistics, running_moments.deviations(statistics, batch, valid))


@pytest.fixture(autouse=True)
def strict():
    with jax.numpy_rank_promotion("raise"):
        yield


def merged(batches, valid=None):
    statistics = running_moments.init(jnp.zeros(batches.shape[-1]))
    jitted = jax.jit(update)
    for i, batch in enumerate(batches):
        mask = jnp.ones(batch.shape[:-1], bool) if valid is None else valid[i]
        statistics = jitted(statistics, batch, mask)
    return statistics


def test_merge_equals_the_statistics_of_everything():
    rng = np.random.default_rng(0)
    # Means far from 0 and drifting: where a naive sum of squares loses all its digits.
    drift = np.linspace(0, 5, 300)[:, None, None, None]
    batches = rng.normal(size=(300, 4, 8, 3)) * [0.1, 1.0, 30.0] + [1000.0, 0.0, -5.0] + drift
    batches = batches.astype(np.float32)
    statistics = merged(batches)
    flat = batches.reshape(-1, 3).astype(np.float64)
    assert count_as_int(statistics.count) == 300 * 32
    np.testing.assert_allclose(statistics.mean.value, flat.mean(0), rtol=2e-6, atol=1e-5)
    np.testing.assert_allclose(statistics.variance.value, flat.var(0), rtol=2e-5)


def test_invalid_samples_leave_no_trace_even_when_nan():
    rng = np.random.default_rng(1)
    batches = rng.normal(size=(5, 6, 2)).astype(np.float32)
    valid = rng.random((5, 6)) < 0.7
    broken = np.where(valid[..., None], batches, np.nan)
    statistics = merged(broken, valid)
    kept = batches[valid]
    assert count_as_int(statistics.count) == len(kept)
    np.testing.assert_allclose(statistics.mean.value, kept.mean(0), rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(statistics.variance.value, kept.var(0), rtol=1e-5)


def test_a_batch_without_valid_samples_changes_nothing():
    first = merged(np.ones((1, 4, 2), np.float32) * 3)
    second = update(first, jnp.full((4, 2), jnp.nan), jnp.zeros(4, bool))
    for before, after in zip(jax.tree.leaves(first), jax.tree.leaves(second), strict=True):
        np.testing.assert_array_equal(before, after)


def test_compensation_keeps_increments_below_the_last_bit():
    """10,000 merges whose increment rounds to nothing by itself still add up."""
    statistics = running_moments.init(jnp.zeros(1))
    count = zero_count().replace(high=jnp.asarray(10, jnp.uint32))  # 4.3e10 samples seen
    one = running_moments.Compensated(jnp.ones(1), jnp.zeros(1))
    statistics = statistics.replace(count=count, mean=one)

    def body(statistics, _):
        batch = jnp.full((4096, 1), 1.5)
        return update(statistics, batch, jnp.ones(4096, bool)), None

    statistics, _ = jax.jit(lambda s: jax.lax.scan(body, s, length=10_000))(statistics)
    seen = 10 * 2**32
    expected = 1.0 + 0.5 * (4096 * 10_000) / (seen + 4096 * 10_000)
    assert expected - 1.0 > 4e-4
    np.testing.assert_allclose(statistics.mean.value - 1.0, [expected - 1.0], rtol=1e-3)


def test_normalize_whitens_clips_and_survives_a_constant_feature():
    rng = np.random.default_rng(2)
    batch = np.stack([rng.normal(5, 3, 1000), np.full(1000, 7.0)], -1).astype(np.float32)
    statistics = merged(batch[None])
    white = running_moments.normalize(statistics, jnp.asarray(batch))
    np.testing.assert_allclose(white.mean(0), 0.0, atol=1e-4)
    np.testing.assert_allclose(white[:, 0].std(), 1.0, rtol=1e-4)
    far = running_moments.normalize(statistics, jnp.asarray([1e6, -1e6]))
    np.testing.assert_array_equal(far, [10.0, -10.0])


def test_dict_observations():
    example = {"policy": jnp.zeros(2), "privileged": jnp.zeros(3)}
    batch = {"policy": jnp.ones((4, 2)), "privileged": jnp.full((4, 3), 2.0)}
    statistics = update(running_moments.init(example), batch, jnp.ones(4, bool))
    np.testing.assert_allclose(statistics.mean["policy"].value, [1, 1])
    np.testing.assert_allclose(statistics.mean["privileged"].value, [2, 2, 2])
