"""The PPO objective against hand-worked tables."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from purerl.ppo import losses


@pytest.fixture(autouse=True)
def strict():
    with jax.numpy_rank_promotion("raise"), jax.numpy_dtype_promotion("strict"):
        yield


def array(*x):
    return jnp.asarray(x, jnp.float32)


@pytest.mark.parametrize(
    ("ratio", "advantage", "expected"),
    [
        (1.0, 2.0, -2.0),
        (1.5, 1.0, -1.2),  # gain beyond the clip is not rewarded
        (1.5, -1.0, 1.5),  # loss beyond the clip is punished in full
        (0.5, 1.0, -0.5),
        (0.5, -1.0, 0.8),
    ],
)
def test_clipped_surrogate(ratio, advantage, expected):
    loss = losses.clipped_surrogate(jnp.log(array(ratio)), array(advantage), 0.2)
    np.testing.assert_allclose(loss, [expected], rtol=1e-6)


@pytest.mark.parametrize(("ratio", "advantage", "moves"), [(1.5, 1.0, 0.0), (1.5, -1.0, 1.5)])
def test_surrogate_gradient_stops_at_the_clip(ratio, advantage, moves):
    def total(log_ratio):
        return losses.clipped_surrogate(log_ratio, array(advantage), 0.2).sum()

    np.testing.assert_allclose(jax.grad(total)(jnp.log(array(ratio))), [moves], rtol=1e-6)


def test_value_loss_plain_and_clipped():
    value, old, target = array(3.0, 1.1, -2.0), array(1.0, 1.0, 1.0), array(0.0, 2.0, -3.0)
    plain = losses.value_loss(value, old, target, None)
    np.testing.assert_allclose(plain, [4.5, 0.405, 0.5], rtol=1e-6)
    # near: 1.5, 1.1, 0.5; the worse of the two errors counts.
    clipped = losses.value_loss(value, old, target, 0.5)
    np.testing.assert_allclose(clipped, [4.5, 0.405, 6.125], rtol=1e-6)


def test_weight_zero_removes_a_sample():
    x, weight = array(1.0, 100.0, 3.0), array(1.0, 0.0, 1.0)
    assert losses.weighted_mean(x, weight) == 2.0
    normalized = losses.normalize_advantage(x, losses.advantage_scale(x, weight))
    np.testing.assert_allclose(normalized[jnp.array([0, 2])], [-1.0, 1.0], rtol=1e-6)


def test_advantage_normalized_over_all_axes():
    advantage = jax.random.normal(jax.random.key(0), (7, 5)) * 3.0 + 2.0
    normalized = np.asarray(
        losses.normalize_advantage(advantage, losses.advantage_scale(advantage, jnp.ones((7, 5))))
    )
    np.testing.assert_allclose(normalized.mean(), 0.0, atol=1e-6)
    np.testing.assert_allclose(normalized.std(), 1.0, rtol=1e-5)


def test_several_minibatches_have_each_their_own_scale():
    advantage = jax.random.normal(jax.random.key(0), (3, 7, 5)) * array(1, 5, 0.1)[:, None, None]
    weight = jax.random.bernoulli(jax.random.key(1), 0.7, (3, 7, 5)).astype(jnp.float32)
    together = losses.advantage_scale(advantage, weight, several=True)
    alone = [losses.advantage_scale(a, w) for a, w in zip(advantage, weight, strict=True)]
    for found, expected in zip(together, zip(*alone, strict=True), strict=True):
        np.testing.assert_allclose(found, jnp.stack(expected), rtol=1e-5, atol=1e-6)


def test_kl_estimate_is_unbiased_and_never_negative():
    """Two Gaussians of scale 1 whose means differ by 0.3: KL = 0.3^2 / 2."""
    x = jax.random.normal(jax.random.key(0), (200_000,))
    log_ratio = -0.5 * jnp.square(x - 0.3) + 0.5 * jnp.square(x)
    estimate = losses.approximate_kl(log_ratio)
    assert estimate.min() >= 0.0
    np.testing.assert_allclose(estimate.mean(), 0.045, rtol=0.02)


def test_explained_variance():
    target, ones = array(1.0, 2.0, 3.0), jnp.ones(3)
    assert losses.explained_variance(target, target, ones) == 1.0
    np.testing.assert_allclose(losses.explained_variance(array(2.0, 2.0, 2.0), target, ones), 0.0)
    # A constant offset costs nothing: the critic's bias is not its explanation.
    assert losses.explained_variance(target + 5.0, target, ones) == 1.0
