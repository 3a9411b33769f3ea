"""The PPO objective against hand-worked tables."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from purerl.core.parts import WHOLE
from purerl.ppo import losses
from purerl.ppo.running_moments import moments_of


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


def test_value_loss():
    np.testing.assert_allclose(losses.value_loss(array(3.0, 1.1), array(0.0, 2.0)), [4.5, 0.405])


def test_weight_zero_removes_a_sample():
    x, weight = array(1.0, 100.0, 3.0), array(1.0, 0.0, 1.0)
    normalized = losses.normalize_advantage(x, moments_of(x, weight > 0), 0.0, 0.0)
    np.testing.assert_allclose(normalized[jnp.array([0, 2])], [-1.0, 1.0], rtol=1e-6)


def test_advantage_normalized_over_all_axes():
    advantage = jax.random.normal(jax.random.key(0), (7, 5)) * 3.0 + 2.0
    moments = moments_of(advantage, jnp.ones((7, 5), bool))
    normalized = np.asarray(losses.normalize_advantage(advantage, moments, 0.0, 0.0))
    np.testing.assert_allclose(normalized.mean(), 0.0, atol=1e-6)
    np.testing.assert_allclose(normalized.std(), 1.0, rtol=1e-5)


def test_one_failure_among_alike_samples_is_clipped_and_the_others_are_not():
    advantage = jnp.zeros(100).at[3].set(-1.0)
    moments = moments_of(advantage, jnp.ones(100, bool))
    whole = losses.normalize_advantage(advantage, moments, 0.0, 0.0)
    clipped = losses.normalize_advantage(advantage, moments, 0.0, 4.0)
    np.testing.assert_allclose(whole[3], -np.sqrt(99.0), rtol=1e-5)
    np.testing.assert_array_equal(clipped, whole.at[3].set(-4.0))


@pytest.mark.parametrize("size, expected", [(1e-4, 0.01), (1.0, 1.0)])
def test_advantages_far_below_their_least_deviation_stay_small(size, expected):
    """Where nothing is rewarded, they are errors of the value, and no reason to move."""
    advantage = size * jax.random.normal(jax.random.key(0), (1000,))
    moments = moments_of(advantage, jnp.ones(1000, bool))
    normalized = losses.normalize_advantage(advantage, moments, 0.01, 0.0)
    np.testing.assert_allclose(normalized.std(), expected, rtol=0.05)


@pytest.mark.parametrize("target, expected", [(0.3, [-0.5, 0.25, 0.3]), (1.0, [-0.5, 0.25, 0.65])])
def test_the_entropy_of_an_action_counts_up_to_its_target(target, expected):
    bonus = losses.bounded_entropy(jnp.array([-1.0, 0.5, 1.3]), 2, target)
    np.testing.assert_allclose(bonus, expected, rtol=1e-6)


def test_kl_estimate_is_unbiased_and_never_negative():
    """Two Gaussians of moments 1 whose means differ by 0.3: KL = 0.3^2 / 2."""
    x = jax.random.normal(jax.random.key(0), (200_000,))
    log_ratio = -0.5 * jnp.square(x - 0.3) + 0.5 * jnp.square(x)
    estimate = losses.approximate_kl(log_ratio)
    assert estimate.min() >= 0.0
    np.testing.assert_allclose(estimate.mean(), 0.045, rtol=0.02)


def explained(value, target):
    value, target, valid = value[None], target[None], jnp.ones((1, 3), bool)  # one part
    return losses.explained_variance(value, target, valid, WHOLE)


def test_explained_variance():
    target = array(1.0, 2.0, 3.0)
    assert explained(target, target) == 1.0
    np.testing.assert_allclose(explained(array(2.0, 2.0, 2.0), target), 0.0)
    # A constant offset costs nothing: the critic's bias is not its explanation.
    assert explained(target + 5.0, target) == 1.0
