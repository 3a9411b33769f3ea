"""Advantages against a hand-worked table and a slow reference."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from purerl.ppo.advantages import discounted_sum, gae

GAMMA, LAMBDA = 0.5, 0.5


def run(reward, value, next_value, terminated, done, valid=None):
    valid = np.ones(len(reward), bool) if valid is None else np.asarray(valid)
    with jax.numpy_rank_promotion("raise"), jax.numpy_dtype_promotion("strict"):
        advantage = gae(
            *(jnp.asarray(x, jnp.float32) for x in (reward, value, next_value)),
            *(jnp.asarray(x, bool) for x in (terminated, done, valid)),
            GAMMA,
            LAMBDA,
        )
    return np.asarray(advantage)


def test_hand_worked_table():
    """Five steps: the episode terminates at step 1; step 3 is truncated; step 4 is cut short.

    t  r  V(s)  V(s')  delta                    decay   A
    4  2  4     6      2 + 0.5 * 6 - 4 =  1     0.25    1
    3  1  2     8      1 + 0.5 * 8 - 2 =  3     0       3           (the value before the reset)
    2  0  4     2      0 + 0.5 * 2 - 4 = -3     0.25    -3 + 0.25 * 3 = -2.25
    1  3  2     4      3 + 0       - 2 =  1     0       1           (nothing comes after)
    0  1  2     2      1 + 0.5 * 2 - 2 =  0     0.25    0.25
    """
    advantage = run(
        reward=[1, 3, 0, 1, 2],
        value=[2, 2, 4, 2, 4],
        next_value=[2, 4, 2, 8, 6],
        terminated=[0, 1, 0, 0, 0],
        done=[0, 1, 0, 1, 0],
    )
    np.testing.assert_array_equal(advantage, [0.25, 1.0, -2.25, 3.0, 1.0])


@pytest.mark.parametrize("done", [0, 1])
def test_invalid_step_passes_nothing_back(done):
    """Step 1 is lost: its advantage is 0 and step 0 bootstraps from its own next value.

    delta_0 = 1 + 0.5 * 4 - 2 = 1 = A_0, although step 1 carries an absurd reward, and step 2,
    of another episode, has the advantage 3 + 0.5 * 2 - 2 = 2. Whether the lost step is done or not
    makes no difference.
    """
    advantage = run(
        reward=[1, 1e5, 3],
        value=[2, 4, 2],
        next_value=[4, 1e5, 2],
        terminated=[0, 0, 0],
        done=[0, done, 0],
        valid=[True, False, True],
    )
    np.testing.assert_array_equal(advantage, [1.0, 0.0, 2.0])


def slow_reference(reward, value, next_value, terminated, done):
    """Sums (gamma lambda)^l delta_{t+l} up to the episode's end, term by term."""
    total = np.zeros(len(reward))
    for t in range(len(reward)):
        for k in range(t, len(reward)):
            delta = reward[k] - value[k]
            if not terminated[k]:
                delta += GAMMA * next_value[k]
            total[t] += (GAMMA * LAMBDA) ** (k - t) * delta
            if done[k]:
                break
    return total


@pytest.mark.parametrize("seed", range(5))
def test_against_slow_reference(seed):
    rng = np.random.default_rng(seed)
    reward, value, next_value = rng.normal(size=(3, 40))
    terminated = rng.random(40) < 0.1
    done = terminated | (rng.random(40) < 0.1)
    expected = slow_reference(reward, value, next_value, terminated, done)
    advantage = run(reward, value, next_value, terminated, done)
    np.testing.assert_allclose(advantage, expected, rtol=1e-5, atol=1e-6)


def test_shapes_must_agree():
    with pytest.raises(AssertionError):
        run([1, 2], [1, 2, 3], [1, 2, 3], [0, 0, 0], [0, 0, 0])


def test_discounted_sum_of_ones_is_a_geometric_series():
    x = discounted_sum(jnp.ones(20), jnp.full(20, 0.5))
    np.testing.assert_allclose(x[0], 2.0, rtol=1e-5)
