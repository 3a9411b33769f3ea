"""What a network names and draws itself: losses with weights, and noise that is replayed."""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from purerl.core.keys import Purpose, derive
from purerl.core.records import Network, Normal, PolicyOutput, add_count, zero_count
from purerl.ppo import episodes, evaluation, optimizer
from tests import quick
from tests.ppo.test_algorithm import (
    CONFIG,
    INIT,
    LEARN,
    LENGTH,
    MAKE_BATCH,
    ROLLOUT,
    Walk,
)
from tests.runs.coded_experiment import Options, build_network

NETWORKS = {hidden: build_network(Options(hidden=hidden), jnp.zeros(2), 1) for hidden in (0, 4)}
WEIGHTS = {"code_kl": (0.0, 0.1, 200), "sparsity": 0.01, "prediction": 1.0}
ONCE = dataclasses.replace(CONFIG, num_epochs=1, num_minibatches=1, auxiliary=WEIGHTS)


def guessing() -> Network:
    """The policy and the value have no parameter; one guesses the first observation."""

    def apply(params, observation, memory):
        x = observation[..., 0]
        normal = Normal(0.0 * x[..., None], 0.0 * x[..., None] + 1.0)
        return PolicyOutput(normal, 0.0 * x, {"guess": jnp.square(params["guess"] - x)}), memory

    return Network(lambda key: ({"guess": jnp.float32(0.7)}, ()), apply)


@pytest.fixture(scope="module", params=[0, 4], ids=["plain", "recurrent"])
def rolled(request):
    network, env = NETWORKS[request.param], Walk()
    state = INIT(ONCE, env, network, jax.random.key(0))
    return network, state, ROLLOUT(ONCE, env, network, state)[1]


def test_the_gradient_of_a_loss_is_that_by_hand():
    network, env = guessing(), Walk(cliff=1.0)  # some steps are lost, and count nowhere
    state = INIT(CONFIG, env, network, jax.random.key(0))
    _, transitions, _ = ROLLOUT(CONFIG, env, network, state)
    batch = MAKE_BATCH(CONFIG, state, transitions)
    valid = np.asarray(batch.valid)
    assert 0 < valid.sum() < valid.size
    x = np.asarray(batch.observation)[..., 0][valid]
    config = dataclasses.replace(ONCE, auxiliary={"guess": 3.0})
    metrics = LEARN(config, network, state, batch, ())[1]
    norm = abs(3.0 * np.mean(2.0 * (0.7 - x)))
    np.testing.assert_allclose(metrics["gradient_norm"], norm, rtol=1e-5)
    np.testing.assert_allclose(metrics["auxiliary/guess"], np.mean((0.7 - x) ** 2), rtol=1e-5)
    assert metrics["auxiliary/guess_weight"] == 3.0
    weighed = 3.0 * metrics["auxiliary/guess"] + metrics["policy_loss"]
    weighed += CONFIG.value_weight * metrics["value_loss"]
    np.testing.assert_allclose(metrics["loss"], weighed, rtol=1e-5)


def test_a_step_is_as_long_as_the_network_scales_it():
    network, config = guessing(), dataclasses.replace(ONCE, auxiliary={"guess": 3.0})
    state = INIT(config, Walk(), network, jax.random.key(0))
    batch = MAKE_BATCH(config, state, ROLLOUT(config, Walk(), network, state)[1])

    def moved(factor):
        scaled = network._replace(scale=lambda directions: {"guess": factor * directions["guess"]})
        return float(LEARN(config, scaled, state, batch, ())[0].params["guess"]) - 0.7

    assert abs(moved(1.0)) == pytest.approx(CONFIG.learning_rate, rel=1e-2)
    assert moved(0.25) == pytest.approx(0.25 * moved(1.0), rel=1e-2)


@pytest.mark.parametrize(
    ("weight", "steps", "expected"),
    [
        (0.3, 10**6, 0.3),
        ((0.1, 0.5, 200), 0, 0.1),
        ((0.1, 0.5, 200), 50, 0.2),
        ((0.1, 0.5, 200), 10**10, 0.5),  # beyond 32 bits
        ((0.5, 0.0, 200), 150, 0.125),
        ((0.1, 0.5, 0), 1, 0.5),
        ([0.1, 0.5, 200], 50, 0.2),
    ],
)
def test_a_weight_rises_over_the_steps_of_the_run(weight, steps, expected):
    count = zero_count()
    for _ in range(10 if steps == 10**10 else 1):
        count = add_count(count, jnp.asarray(min(steps, 10**9), jnp.uint32))
    state = type("State", (), {"steps": count})
    config = dataclasses.replace(CONFIG, auxiliary={"x": weight})
    assert optimizer.auxiliary_weights(config, state)["x"] == pytest.approx(expected)


def test_noise_is_drawn_by_its_use_and_replayed(rolled):
    network, state, transitions = rolled
    (noise,) = transitions.drawn
    assert noise.shape == (16, 6, 2)
    key = jax.random.fold_in(derive(state.key, Purpose.NETWORK, state.update, 5), 3)
    np.testing.assert_allclose(noise[5, 3], jax.random.normal(key, (2,)), rtol=1e-6)
    assert len(np.unique(noise)) == noise.size
    some = quick.jit(lambda ids: episodes.draw(network, state.key, ids, state.update, 5))
    np.testing.assert_allclose(some(jnp.arange(3, 6))[0], noise[5, 3:], rtol=1e-6)
    batch = MAKE_BATCH(ONCE, state, transitions)
    np.testing.assert_array_equal(batch.drawn[0], noise)


def test_the_first_ratio_is_one_by_the_noise_of_the_rollout(rolled):
    """The step's log-probability is that of the code which acted, to the bit."""
    network, state, transitions = rolled
    batch = MAKE_BATCH(ONCE, state, transitions)
    metrics = LEARN(ONCE, network, state, batch, state.memory)[1]
    assert abs(metrics["kl"]) < 1e-10 and metrics["clip_fraction"] == 0.0
    other = batch._replace(drawn=(batch.drawn[0][::-1],))
    assert LEARN(ONCE, network, state, other, state.memory)[1]["kl"] > 1e-3


def test_an_evaluation_by_the_mean_draws_nothing(rolled):
    network, state, _ = rolled

    def none(key):
        raise AssertionError("it draws")

    def returns(network, deterministic):
        judge = partial(evaluation.evaluate_policy, Walk(), network, num_episodes=4)
        judge = partial(judge, episode_length=LENGTH, deterministic=deterministic)
        return quick.jit(judge)(state, jax.random.key(1))["episode_return"]

    silent = network._replace(draw=none)
    by_mean = returns(silent, True)
    with pytest.raises(AssertionError, match="it draws"):
        returns(silent, False)
    still = network._replace(draw=lambda key: jnp.zeros(2))
    assert (by_mean != returns(network, False)).all()
    assert (returns(still, False) != returns(network, False)).all()
