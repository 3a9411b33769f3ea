"""PPO solves each probe in seconds, and fails it when the part that the probe is for is broken."""

from functools import partial

import jax
import jax.numpy as jnp
import pytest

from purerl.ppo import (
    advantages,
    algorithm,
    distributions,
    evaluation,
    losses,
    networks,
    running_moments,
)
from purerl.ppo.episodes import act
from tests import quick
from tests.ppo.probes import Burst, Point, Probe

SMALL = networks.MlpOptions(policy_hidden=(32,), value_hidden=(32,))
CONFIG = algorithm.Config.plain(
    num_steps=64 * 16 * 60,
    num_envs=64,
    rollout_length=16,
    num_epochs=4,
    num_minibatches=4,
    learning_rate=5e-3,
    gamma=0.5,
    gae_lambda=0.9,
    episode_length=50,
)


def train(config, env, network, seed=0):
    state = quick.jit(partial(algorithm.init, config, env, network))(jax.random.key(seed))
    update = quick.jit(partial(algorithm.update, config, env, network), donate_argnums=0)
    for _ in range(config.num_updates):
        state, metrics = update(state)
    return state, metrics


def answers(network, state, observations):
    """Values and deterministic actions for `observations` (list of numbers)."""
    example = jax.tree.map(lambda x: x[: len(observations)], state.env_state)
    shown = example.replace(observation=jnp.asarray(observations, jnp.float32)[:, None])
    memory = jax.tree.map(lambda x: x[: len(observations)], state.memory)
    output, _ = act(network, state, shown, memory)
    action = distributions.to_action(output.distribution.loc)
    return output.value.tolist(), action[:, 0].tolist()


def errors(name):
    """Trains on a probe; returns the largest error of what it should have learned."""
    steps = 2 if name == "discounting" else 1
    env = Probe(name, steps=steps)
    network = networks.mlp(SMALL, jnp.zeros(1), 1)
    state, _ = train(CONFIG, env, network)
    if name == "value":
        (value,), _ = answers(network, state, [0.0])
        return abs(value - 1.0)
    if name == "observation":
        values, _ = answers(network, state, [-1.0, 1.0])
        return max(abs(values[0] + 1.0), abs(values[1] - 1.0))
    if name == "discounting":
        values, _ = answers(network, state, [0.0, 1.0])
        return max(abs(values[0] - CONFIG.gamma), abs(values[1] - 1.0))
    if name == "policy":
        _, (action,) = answers(network, state, [0.0])
        return abs(action - 0.5)
    _, actions = answers(network, state, [-1.0, 1.0])
    return max(abs(actions[0] + 0.5), abs(actions[1] - 0.5))


TOLERANCE = 0.1
PROBES = ("value", "observation", "discounting", "policy", "both")


@pytest.mark.parametrize("name", PROBES)
def test_probe_is_solved(name):
    assert errors(name) < TOLERANCE


def no_value_gradient(value, target):
    return jnp.zeros_like(value)


def blind(statistics, features):
    return jax.tree.map(jnp.zeros_like, features)


def undiscounted(reward, value, next_value, terminated, gamma):
    return reward + jnp.where(terminated, 0.0, next_value) - value


def ascending(log_ratio, advantage, clip):
    return -CLIPPED_SURROGATE(log_ratio, advantage, clip)


CLIPPED_SURROGATE = losses.clipped_surrogate
BREAKS = {
    "value": (losses, "value_loss", no_value_gradient),
    "observation": (running_moments, "normalize", blind),
    "discounting": (advantages, "temporal_difference", undiscounted),
    "policy": (losses, "clipped_surrogate", ascending),
    "both": (running_moments, "normalize", blind),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", PROBES)
def test_probe_fails_when_its_part_is_broken(name, monkeypatch):
    module, function, broken = BREAKS[name]
    monkeypatch.setattr(module, function, broken)
    assert errors(name) > 2 * TOLERANCE


def memory_error(build, options):
    env = Probe("memory", steps=4)
    network = build(options, jnp.zeros(1), 1)
    config = algorithm.Config.plain(
        num_steps=128 * 16 * 120,
        num_envs=128,
        rollout_length=16,
        num_epochs=4,
        num_minibatches=4,
        learning_rate=5e-3,
        gamma=0.9,
        schedule="linear",
        episode_length=50,
    )
    _, metrics = train(config, env, network)
    return float(-metrics["episode_return"])


@pytest.mark.slow
def test_a_bonus_for_being_alive_does_not_spoil_the_first_updates():
    """Four seeds; with rewards that the first update does not divide, they have -100 here."""
    env = Point(alive=1.0)
    config = algorithm.Config(
        num_steps=96_000, num_envs=64, rollout_length=50, episode_length=50,
        shortest_episode=0, noise_color=0.0,
    )  # fmt: skip
    options = networks.MlpOptions(policy_hidden=(64, 64), value_hidden=(64, 64))
    network = networks.mlp(options, jnp.zeros(2), 2)

    def returns(seed):
        state = algorithm.init(config, env, network, jax.random.key(seed))
        update = partial(algorithm.update, config, env, network)
        state, _ = jax.lax.scan(lambda state, _: update(state), state, None, 10)
        judged = evaluation.evaluate_policy(env, network, state, jax.random.key(9), 32, 50)
        return judged["episode_return"].mean() - 50.0  # of 50: at the origin from the start

    assert jax.jit(jax.vmap(returns))(jnp.arange(1, 5)).min() > 40.0


@pytest.mark.slow
@pytest.mark.parametrize("cell", ["gru", pytest.param("lstm", marks=pytest.mark.nightly)])
def test_recurrent_network_remembers_the_cue(cell):
    options = networks.RecurrentOptions(cell=cell, hidden=32, encoder=(32,), value_hidden=(32,))
    assert memory_error(networks.recurrent, options) < 0.1


@pytest.mark.slow
def test_feed_forward_network_cannot_remember_the_cue():
    # The best it can do is action 0, for a squared error of 0.25.
    assert memory_error(networks.mlp, SMALL) > 0.22


def test_a_state_that_is_lost_next_teaches_no_value_without_end():
    """10 s. What bootstrapped from such a state had a value loss of 600 here, later of 1e12."""
    config = algorithm.Config(
        num_steps=64 * 32 * 40, num_envs=64, rollout_length=32, num_minibatches=8
    )
    _, metrics = train(config, Burst(), networks.mlp(SMALL, jnp.zeros(6), 1))
    assert metrics["nonfinite_resets"] > 30 and metrics["value_loss"] < 1.0
