"""PPO semantics: each line against a slow, obvious reference."""

import dataclasses
from functools import partial
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, strategies as st

from purerl.core.env import State
from purerl.core.parts import WHOLE, as_one_part
from purerl.core.records import count_as_int
from purerl.ppo import (
    algorithm,
    batches,
    episodes,
    evaluation,
    learner,
    networks,
    optimizer,
    running_moments,
)
from purerl.ppo.episodes import time_limits
from purerl.ppo.rollout import rollout
from tests import quick
from tests.ppo.test_running_moments import update as merge_batch

MLP = networks.MlpOptions(policy_hidden=(8,), value_hidden=(8,))
GRU = networks.RecurrentOptions(hidden=8, encoder=(8,), value_hidden=(8,))
LENGTH = 7
CONFIG = algorithm.Config.plain(
    num_steps=6 * 16 * 100,
    num_envs=6,
    rollout_length=16,
    num_epochs=2,
    num_minibatches=3,
    episode_length=LENGTH,
    gamma=0.9,
    learning_rate=1e-2,
)


@dataclasses.dataclass(frozen=True)
class Walk:
    """A number that drifts by the action; terminates beyond `edge`; NaN beyond `cliff`."""

    edge: float = 1e3
    cliff: float = 1e3
    unit: float = 1.0  # of the reward
    control_timestep: float = 1.0
    action_size: int = 1

    def reset(self, key):
        x = jax.random.uniform(key, (), minval=-0.5, maxval=0.5)
        return self.state(x, jnp.zeros(()), x)

    def step(self, state, action):
        x = state.physics["x"] + action[0]
        return self.state(x, self.unit * (x - state.physics["x"]), state.task["start"])

    def state(self, x, reward, start):
        broken = jnp.where(jnp.abs(x) > self.cliff, jnp.nan, x)
        return State(
            physics={"x": broken},
            observation=jnp.stack([broken, jnp.square(broken)]),
            reward=reward + jnp.where(jnp.abs(x) > self.cliff, jnp.nan, 0.0),
            terminated=jnp.abs(x) > self.edge,
            truncated=jnp.zeros((), bool),
            metrics={"position": broken, "moves_count": jnp.ones(())},
            task={"start": start},
        )


INIT = quick.jit(algorithm.init, static_argnums=(0, 1, 2))
UPDATE = quick.jit(algorithm.update, static_argnums=(0, 1, 2))
ROLLOUT = quick.jit(rollout, static_argnums=(0, 1, 2))
NETWORKS = {
    False: networks.mlp(MLP, jnp.zeros(2), 1),
    True: networks.recurrent(GRU, jnp.zeros(2), 1),
}


def setup(config=CONFIG, env=None, recurrent=False, seed=0):
    """An initial state whose statistics are not trivial, and everything that made it."""
    env = Walk() if env is None else env
    network = NETWORKS[recurrent]
    state = INIT(config, env, network, jax.random.key(seed))
    samples = jax.random.normal(jax.random.key(9), (50, 2)) * 2.0 + 0.3
    statistics = MERGE(state.normalizer, samples, jnp.ones(50, bool))
    return env, network, state.replace(normalizer=statistics)


def learn(config, network, state, batch, memory):
    """Learns from one part."""
    batch, memory, part_id = as_one_part((batch, memory, jnp.zeros((), jnp.int32)))
    return learner.learn(config, network, state, batch, memory, part_id, WHOLE)


LEARN = quick.jit(learn, static_argnums=(0, 1))
MAKE_BATCH = quick.jit(batches.make_batch, static_argnums=0)
MERGE = quick.jit(merge_batch)
EVALUATE = quick.jit(evaluation.evaluate_policy, static_argnums=(0, 1, 4, 5))


@pytest.mark.parametrize("recurrent", [False, True])
@pytest.mark.parametrize("color", [0.0, 1.0])
def test_the_first_ratio_is_one(recurrent, color):
    """Before any gradient step, the learner computes the very log-probability that acted."""
    config = dataclasses.replace(
        CONFIG, num_epochs=1, num_minibatches=1, num_envs=6, noise_color=color
    )
    env, network, state = setup(config, recurrent=recurrent)
    _, metrics = UPDATE(config, env, network, state)
    assert abs(metrics["kl"]) < 1e-10
    assert metrics["clip_fraction"] == 0.0


def test_statistics_are_frozen_until_the_end_of_the_update():
    env, network, state = setup()
    after, transitions, _ = ROLLOUT(CONFIG, env, network, state)
    assert count_as_int(after.normalizer.count) == 50
    updated, _ = UPDATE(CONFIG, env, network, state)
    assert count_as_int(updated.normalizer.count) == 50 + 6 * 16
    expected = MERGE(state.normalizer, transitions.observation, jnp.ones((16, 6), bool))
    np.testing.assert_allclose(
        updated.normalizer.mean.value, expected.mean.value, rtol=1e-5, atol=1e-6
    )


def test_time_limits_truncate_and_the_first_are_staggered():
    env, network, state = setup()
    limits = np.asarray(state.episode.limit)
    assert len(set(limits.tolist())) > 2 and limits.max() <= LENGTH and limits.min() >= 1
    _, transitions, finished = ROLLOUT(CONFIG, env, network, state)
    done = np.asarray(transitions.done)
    for b in range(6):
        ends = np.flatnonzero(done[:, b]) + 1
        assert ends[0] == limits[b]
        assert (np.diff(ends) == LENGTH).all()
    assert not transitions.terminated.any()
    np.testing.assert_array_equal(transitions.truncated, done)
    np.testing.assert_array_equal(finished["episodes"], done.sum(0))


def test_training_episodes_have_limits_from_the_shortest_to_whole_ones_each_environment_its_own():
    config = dataclasses.replace(CONFIG, shortest_episode=2)
    env, network, _ = setup()
    state = INIT(config, env, network, jax.random.key(4))
    own = [2, 3, 3, 4, 5, 7]  # 2 * (7 / 2) ** (i / 5), to the nearest
    assert (np.asarray(state.episode.limit) <= own).all()
    _, transitions, _ = ROLLOUT(config, env, network, state)
    for b in range(6):
        ends = np.flatnonzero(np.asarray(transitions.truncated)[:, b]) + 1
        assert ends[0] == state.episode.limit[b]
        assert (np.diff(ends) == own[b]).all()
    part = state.replace(env_ids=jnp.array([4, 1]))  # of a shard: numbers of the whole
    np.testing.assert_array_equal(time_limits(config, part.env_ids), [5, 3])
    for none in (0, LENGTH, LENGTH + 1):  # a planner, too, shortens episodes and asks no one
        whole = dataclasses.replace(config, shortest_episode=none)
        np.testing.assert_array_equal(time_limits(whole, part.env_ids), [LENGTH, LENGTH])
    alone = dataclasses.replace(config, num_envs=1)
    np.testing.assert_array_equal(time_limits(alone, jnp.array([0])), [LENGTH])


def test_every_environment_and_update_has_a_fresh_start():
    """One that ends twice in an update begins again as it began before, and that is counted."""
    env, network, state = setup()
    update = partial(UPDATE, CONFIG, env, network)
    starts = set(np.asarray(state.env_state.physics["x"]).tolist())
    for _ in range(2):
        _, transitions, _ = ROLLOUT(CONFIG, env, network, state)
        done = np.asarray(transitions.done)[:-1]
        begins = np.asarray(transitions.observation)[1:, :, 0]
        for b in range(6):
            own = set(begins[done[:, b], b].tolist())
            assert len(own) == 1 and not own & starts
            starts |= own
        state, metrics = update(state)
        ends = np.asarray(transitions.done).sum(0)
        assert metrics["replayed_resets"] == np.maximum(ends - 1, 0).sum() > 0


@pytest.mark.parametrize(
    "schedule, update, rate", [("constant", 3, 0.5), ("linear", 25, 0.375), ("adaptive_kl", 3, 0.1)]
)
def test_where_the_learning_rate_of_an_update_comes_from(schedule, update, rate):
    """100 updates; 0.5 is the setting, 0.1 what the state was left with."""
    config = dataclasses.replace(CONFIG, schedule=schedule, learning_rate=0.5)
    state = setup()[2].replace(learning_rate=jnp.float32(0.1), update=jnp.int32(update))
    assert optimizer.scheduled_rate(config, state) == pytest.approx(rate)


def slow_batch(transitions, last_value, observations_before_reset, value_of, gamma, lambda_):
    """Advantages, one step at a time, with V of the observation before each reset."""
    steps, size = transitions.reward.shape
    advantage = np.zeros((steps + 1, size))
    for t in reversed(range(steps)):
        for b in range(size):
            if transitions.truncated[t, b]:
                following = value_of(observations_before_reset[t, b])
            else:
                following = transitions.value[t + 1, b] if t + 1 < steps else last_value[b]
            alive = 1.0 - transitions.terminated[t, b]
            delta = transitions.reward[t, b] + gamma * alive * following - transitions.value[t, b]
            carry = 0.0 if transitions.done[t, b] else gamma * lambda_ * advantage[t + 1, b]
            advantage[t, b] = delta + carry
    return advantage[:-1]


def test_truncation_bootstraps_from_the_observation_before_the_reset():
    env, network, state = setup(env=Walk(edge=1.5))
    after, transitions, _ = ROLLOUT(CONFIG, env, network, state)
    batch = MAKE_BATCH(CONFIG, state, transitions)
    transitions = jax.tree.map(np.asarray, transitions)
    assert transitions.terminated.any() and transitions.truncated.any()
    moved = transitions.observation[..., 0] + np.tanh(transitions.raw_action[..., 0])
    before_reset = np.stack([moved, moved**2], -1)

    def value_of(observation):
        features = running_moments.normalize(state.normalizer, jnp.asarray(observation))
        return float(network.apply(state.params, features, ())[0].value)

    last_value = [value_of(seen) for seen in after.env_state.observation]
    expected = slow_batch(transitions, last_value, before_reset, value_of, 0.9, CONFIG.gae_lambda)
    np.testing.assert_allclose(batch.advantage, expected, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(batch.target, expected + transitions.value, rtol=1e-4, atol=1e-5)
    is_first = np.asarray(batch.is_first)
    np.testing.assert_array_equal(is_first[1:], transitions.done[:-1])
    assert is_first[0].all()


@pytest.mark.slow
def test_recurrent_memory_restarts_with_each_episode_in_rollout_and_learner():
    """The learner's unroll, from the stored memory, gives the rollout's values."""
    env, network, state = setup(recurrent=True)
    update = partial(UPDATE, CONFIG, env, network)
    for _ in range(2):  # so that memories are not zero when the rollout begins
        state, _ = update(state)
    assert jnp.abs(state.memory).max() > 0
    _, transitions, _ = ROLLOUT(CONFIG, env, network, state)
    batch = MAKE_BATCH(CONFIG, state, transitions)
    output = learner.unroll(network, state.params, batch, state.memory)
    np.testing.assert_allclose(output.value, transitions.value, rtol=1e-5, atol=1e-6)
    # By hand: at a start the memory is zero.
    t, b = np.argwhere(np.asarray(batch.is_first)[1:])[0] + [1, 0]
    features = batch.observation[t, b]
    fresh = network.apply(state.params, features, jnp.zeros(8))[0].value
    np.testing.assert_allclose(transitions.value[t, b], fresh, rtol=1e-5, atol=1e-6)


@dataclasses.dataclass(frozen=True)
class BadStarts(Walk):
    """One of five starts is NaN."""

    def reset(self, key):
        state = super().reset(key)
        x = jnp.where(jnp.abs(state.physics["x"]) > 0.4, jnp.nan, state.physics["x"])
        return self.state(x, jnp.zeros(()), x)


@pytest.mark.slow
@pytest.mark.parametrize("cell", ["gru", "lstm"])
def test_all_steps_at_once_teach_what_they_teach_one_after_another(cell):
    """The same outputs and gradients, with episodes that begin in the middle of a rollout."""
    options = dataclasses.replace(GRU, cell=cell)
    network = networks.recurrent(options, jnp.zeros(2), 1)
    params, one = network.init(jax.random.key(0))
    rng = np.random.default_rng(1)
    memory = jax.tree.map(lambda x: rng.normal(size=(4, *x.shape)).astype(np.float32), one)
    seen, begins = rng.normal(size=(7, 4, 2)).astype(np.float32), rng.uniform(size=(7, 4)) < 0.3
    batch = SimpleNamespace(observation=seen, is_first=begins, drawn=())

    def learned(network):
        def total(params):
            output = learner.unroll(network, params, batch, memory)
            return sum(jnp.sin(x).sum() for x in jax.tree.leaves(output)), output

        return jax.value_and_grad(total, has_aux=True)(params)

    assert network.apply.sequences and begins[1:].any()
    steps = network._replace(apply=lambda *given: network.apply(*given))
    for a, b in zip(*map(jax.tree.leaves, map(learned, (network, steps))), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("recurrent", [False, True])
def test_a_start_that_is_no_number_costs_its_own_step_alone(recurrent):
    env, network, state = setup(env=BadStarts(), recurrent=recurrent)
    for _ in range(3):
        state, metrics = UPDATE(CONFIG, env, network, state)
        assert metrics["nonfinite_resets"] > 0 and metrics["skipped_minibatches"] == 0
        assert all(np.isfinite(x) for x in metrics.values())
    for leaf in jax.tree.leaves((state.params, state.optimizer, state.normalizer)):
        assert np.isfinite(np.asarray(leaf, np.float64)).all()


def test_a_blown_up_environment_is_contained():
    """Environment 3 goes NaN: counted, reset, not learned from; the others' bits are the same."""
    sound_env, network, state = setup()
    # The second move of environment 3 alone leads beyond the cliff.
    x = state.env_state.physics["x"].at[3].set(-38.9)
    state = state.replace(env_state=state.env_state.replace(physics={"x": x}))
    broken_env = Walk(cliff=38.5)
    after, sound, _ = ROLLOUT(CONFIG, sound_env, network, state)
    contained, lost, finished = ROLLOUT(CONFIG, broken_env, network, state)
    assert (~np.asarray(lost.valid)).sum(0).tolist()[3] >= 1
    assert (
        finished["nonfinite_resets"].sum() == (~lost.valid).sum() == finished["nonfinite_resets"][3]
    )
    # The first lost step is left out: what follows the one before is the start of a new episode.
    t = int(np.argmin(lost.valid[:, 3]))
    assert 0 < t < len(lost.valid) - 1 and lost.is_first[t + 1, 3]
    assert lost.next_value[t - 1, 3] == lost.value[t + 1, 3] != sound.next_value[t - 1, 3]
    for a, b in zip(jax.tree.leaves(sound), jax.tree.leaves(lost), strict=True):
        others = [0, 1, 2, 4, 5]
        np.testing.assert_array_equal(np.asarray(a)[:, others], np.asarray(b)[:, others])
    for leaf in jax.tree.leaves((lost, contained.env_state, contained.episode)):
        assert np.isfinite(np.asarray(leaf, np.float64)).all()
    updated, metrics = UPDATE(CONFIG, broken_env, network, state)
    assert metrics["nonfinite_resets"] >= 1 and metrics["skipped_minibatches"] == 0
    valid = int(lost.valid.sum())
    assert count_as_int(updated.normalizer.count) == 50 + valid < 50 + 6 * 16
    for leaf in jax.tree.leaves(updated.params):
        assert jnp.isfinite(leaf).all()


def test_a_truncated_step_keeps_its_value_where_the_next_start_is_lost():
    env, network, state = setup()
    _, sound, _ = ROLLOUT(CONFIG, env, network, state)
    _, lost, _ = ROLLOUT(CONFIG, BadStarts(), network, state)
    first, columns = np.argmax(sound.truncated, 0), np.arange(6)
    at = columns[sound.truncated[first, columns] & ~lost.valid[first + 1, columns]]
    assert len(at)
    np.testing.assert_array_equal(lost.next_value[first[at], at], sound.next_value[first[at], at])


class Fragile(BadStarts):
    """Lost by every fourth action, more or less, also from a start."""

    def step(self, state, action):
        moved = super().step(state, action)
        x = jnp.where(action[0] > 0.5, jnp.nan, moved.physics["x"])
        return self.state(x, moved.reward, state.task["start"])


def test_what_follows_a_step_is_the_next_one_that_is_taught():
    """However many are lost in a row. None is, if the start that is left is no number: then 0."""
    _, network, state = setup()
    after, found, _ = ROLLOUT(CONFIG, Fragile(), network, state)
    valid, value = np.asarray(found.valid), np.asarray(found.value)
    last = episodes.act(network, after, after.env_state, after.memory)[0].value
    last, in_a_row = np.nan_to_num(np.asarray(last)), 0
    assert valid[0].any() and np.isfinite(found.next_value).all() and (last == 0).any()
    for t, b in np.argwhere(valid & ~np.asarray(found.done)):
        taught = t + 1 + np.flatnonzero(valid[t + 1 :, b])
        right = value[taught[0], b] if len(taught) else last[b]
        np.testing.assert_allclose(found.next_value[t, b], right, rtol=1e-5)
        in_a_row += not valid[t + 1 : t + 3, b].any()
    assert in_a_row > 2


def test_an_episode_that_is_lost_counts_nothing():
    """A success that is counted first and taken back at the end would be one."""
    env, network, state = setup(env=Walk(cliff=3.0))
    key = jax.random.key(1)
    found = evaluation.evaluate_policy(env, network, state, key, 8, 30, False)
    lost = np.asarray(found["lost"], bool)
    assert 0 < lost.sum() < 8
    moves = np.asarray(found["moves_count"])
    assert (moves[lost] == 0).all() and (moves[~lost] == 30).all()


def test_a_lost_sample_has_no_weight_in_the_update():
    """Whatever stands in the lost rows, the gradient is the same."""
    env, network, state = setup()
    _, transitions, _ = ROLLOUT(CONFIG, env, network, state)
    valid = transitions.valid.at[5, 2].set(False)
    done = transitions.done.at[5, 2].set(True)
    lost = transitions._replace(valid=valid, done=done)
    odd = lost._replace(
        reward=lost.reward.at[5, 2].set(1e4), raw_action=lost.raw_action.at[5, 2].set(3.0)
    )
    learned = []
    for x in (lost, odd):
        batch = MAKE_BATCH(CONFIG, state, x)
        learned.append(LEARN(CONFIG, network, state, batch, ())[0])
    for a, b in zip(*(jax.tree.leaves(x.params) for x in learned), strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("least, clip", [(0.0, 0.0), (0.0, 1.5), (5.0, 0.0), (5.0, 1.5)])
def test_advantages_are_clipped_after_they_are_normalized(least, clip):
    """The first ratio is 1: the loss of one minibatch is minus the mean of what it was given."""
    env, network, state = setup()
    _, transitions, _ = ROLLOUT(CONFIG, env, network, state)
    batch = MAKE_BATCH(CONFIG, state, transitions)
    advantage = jnp.linspace(-1.0, 1.0, 96).reshape(16, 6).at[5, 2].set(-30.0)  # one failure
    config = dataclasses.replace(
        CONFIG, num_epochs=1, num_minibatches=1, advantage_clip=clip, min_advantage_std=least
    )
    batch = batch._replace(advantage=advantage)
    metrics = LEARN(config, network, state, batch, ())[1]
    assert 1.0 < advantage.std() < 5.0
    given = (advantage - advantage.mean()) / max(advantage.std(), least)
    if clip:
        given = np.clip(given, -clip, clip)
    np.testing.assert_allclose(metrics["policy_loss"], -given.mean(), atol=1e-6)


def test_the_entropy_bonus_leaves_a_policy_alone_that_is_above_its_target():
    env, network, state = setup()
    _, transitions, _ = ROLLOUT(CONFIG, env, network, state)
    batch = MAKE_BATCH(CONFIG, state, transitions)

    def moved(**settings):
        config = dataclasses.replace(CONFIG, num_epochs=1, num_minibatches=1, **settings)
        return np.concatenate([x.ravel() for x in jax.tree.leaves(
            LEARN(config, network, state, batch, ())[0].params)])  # fmt: skip

    none = moved(entropy_weight=0.0)  # its entropy is about 0.5
    np.testing.assert_allclose(moved(entropy_weight=1.0, entropy_target=0.1), none, atol=1e-7)
    assert np.abs(moved(entropy_weight=1.0, entropy_target=0.68) - none).max() > 1e-4


def altered(network, change):
    """The network with other parameters or another memory, which its `apply` undoes."""

    def init(key):
        params, memory = network.init(key)
        return change(params, memory)

    return network._replace(init=init)


@pytest.mark.slow
def test_parameters_of_half_precision_stay_so():
    half = altered(
        NETWORKS[False],
        lambda params, memory: (jax.tree.map(lambda x: x.astype(jnp.bfloat16), params), memory),
    )
    state, metrics = UPDATE(CONFIG, Walk(), half, INIT(CONFIG, Walk(), half, jax.random.key(0)))
    assert {x.dtype.name for x in jax.tree.leaves(state.params)} == {"bfloat16"}
    assert metrics["skipped_minibatches"] == 0 and metrics["gradient_norm"] > 0


def unmade(function, *arguments):
    with pytest.raises(ValueError) as error:
        function(*arguments)
    return str(error.value)


@pytest.mark.parametrize("std", ["learned", "state"])
def test_the_scale_of_a_policy_stays_above_its_least(std):
    options = networks.MlpOptions(
        policy_hidden=(8,), value_hidden=(8,), std=std, initial_std=0.5, min_std=0.2
    )
    network = networks.mlp(options, jnp.zeros(2), 3)
    params, memory = network.init(jax.random.key(0))
    begun = network.apply(params, jnp.zeros((4, 2)), memory)[0].distribution.scale
    np.testing.assert_allclose(begun, 0.7, atol=1e-3)
    pressed = jax.tree.map(lambda x: x - 100.0, params)  # its logarithm is far below 0
    least = network.apply(pressed, jnp.zeros((4, 2)), memory)[0].distribution.scale
    np.testing.assert_allclose(least, 0.2, atol=1e-6)


def test_what_a_network_cannot_read_is_told():
    zeros = jnp.zeros(2)
    said = unmade(networks.mlp, MLP, {"state": zeros, "privileged": zeros}, 1)
    assert "dict of privileged, state" in said and "must be called policy" in said
    assert "is of shape (3, 2); this network takes arrays [O]" in unmade(
        networks.recurrent, GRU, jnp.zeros((3, 2)), 1
    )
    assert "part eyes is a dict" in unmade(networks.mlp, MLP, {"policy": zeros, "eyes": {}}, 1)
    assert "initial_std is 0.0" in unmade(lambda: networks.MlpOptions(initial_std=0.0))
    assert "min_std is 0.0" in unmade(lambda: networks.MlpOptions(min_std=0.0))
    assert "starts an episode at zero" in unmade(
        networks.from_linen, networks.RecurrentActorCritic(GRU, 1), zeros, jnp.ones(8)
    )
    networks.mlp(MLP, {"policy": zeros, "privileged": zeros}, 1)


@pytest.mark.parametrize(("name", "value"), [("value_weight", -1.0), ("entropy_weight", jnp.nan)])
def test_weights_have_a_sign(name, value):
    assert name in unmade(lambda: dataclasses.replace(CONFIG, **{name: value}))


@pytest.mark.slow
def test_a_memory_may_hold_integers():
    def apply(params, observation, memory):
        output, cell = NETWORKS[True].apply(params, observation, memory["cell"])
        return output, {"cell": cell, "count": memory["count"] + 1}

    counting = altered(
        NETWORKS[True], lambda params, memory: (params, {"cell": memory, "count": jnp.int32(0)})
    )._replace(apply=apply)
    state = INIT(CONFIG, Walk(), counting, jax.random.key(0))
    state, metrics = UPDATE(CONFIG, Walk(), counting, state)
    assert state.memory["count"].dtype == jnp.int32 and metrics["skipped_minibatches"] == 0
    EVALUATE(Walk(), counting, state, jax.random.key(1), 2, LENGTH)


def test_a_non_finite_minibatch_is_skipped_and_counted():
    env, network, state = setup()
    _, transitions, _ = ROLLOUT(CONFIG, env, network, state)
    broken = transitions._replace(reward=transitions.reward.at[:].set(jnp.nan))
    batch = MAKE_BATCH(CONFIG, state, broken)
    after, metrics = LEARN(CONFIG, network, state, batch, ())
    assert metrics["skipped_minibatches"] == metrics["skipped_in_a_row"] == 6
    assert np.isfinite(metrics["policy_loss"])
    for a, b in zip(jax.tree.leaves(state.params), jax.tree.leaves(after.params), strict=True):
        np.testing.assert_array_equal(a, b)
    sound = MAKE_BATCH(CONFIG, state, transitions)
    again, _ = LEARN(CONFIG, network, after, sound, ())
    assert again.skipped_in_a_row == 0


def test_linear_schedule_and_exact_budget():
    config = dataclasses.replace(CONFIG, schedule="linear", num_steps=6 * 16 * 4 + 95)
    assert config.num_updates == 4
    assert config.num_updates * config.steps_per_update <= config.num_steps
    env, network, state = setup(config)
    update = partial(UPDATE, config, env, network)
    rates = []
    for _ in range(config.num_updates):
        state, metrics = update(state)
        rates.append(float(metrics["learning_rate"]))
    np.testing.assert_allclose(rates, [1e-2, 7.5e-3, 5e-3, 2.5e-3], rtol=1e-6)
    assert count_as_int(state.steps) == 6 * 16 * 4


@pytest.mark.parametrize(("kl", "factor"), [(0.001, 1.5), (0.01, 1.0), (0.1, 1 / 1.5)])
def test_adaptive_learning_rate(kl, factor):
    config = dataclasses.replace(CONFIG, schedule="adaptive_kl", desired_kl=0.01)
    rate = optimizer.next_rate(config, jnp.asarray(1e-3), jnp.asarray(kl), jnp.asarray(True))
    np.testing.assert_allclose(rate, 1e-3 * factor, rtol=1e-6)
    unmoved = optimizer.next_rate(config, jnp.asarray(1e-3), jnp.asarray(kl), jnp.asarray(False))
    np.testing.assert_allclose(unmoved, 1e-3)
    for outside, moves in ((2e-6, max(factor, 1.0)), (0.1, min(factor, 1.0))):  # towards the range
        rate = optimizer.next_rate(config, jnp.asarray(outside), jnp.asarray(kl), jnp.asarray(True))
        np.testing.assert_allclose(rate, outside * moves, rtol=1e-6)


def test_reward_scaling_by_the_running_return():
    config = dataclasses.replace(CONFIG, reward_scaling="return_std")
    env, network, state = setup(config)
    assert batches.reward_factor(config, state) == 1.0
    _, transitions, _ = ROLLOUT(config, env, network, state)
    state, _ = UPDATE(config, env, network, state)
    # By hand: G_t = gamma G_{t-1} + r_t, from 0 after each end.
    reward, done = np.asarray(transitions.reward), np.asarray(transitions.done)
    running, returns = np.zeros(6), []
    for r, d in zip(reward, done, strict=True):
        running = 0.9 * running + r
        returns.append(running.copy())
        running[d] = 0.0
    np.testing.assert_allclose(batches.reward_factor(config, state), 1 / np.std(returns), rtol=1e-4)


def test_what_is_learned_does_not_depend_on_the_unit_of_rewards():
    """Neither in the first update, nor in the first one of a stage whose reward is another."""
    config = dataclasses.replace(CONFIG, reward_scaling="return_std", num_epochs=1)
    env, network, first = setup(config)
    later, _ = UPDATE(config, env, network, first)
    for state in (first, algorithm.start_stage(later)):
        learned = [UPDATE(config, Walk(unit=unit), network, state) for unit in (1.0, 1e4)]
        one, other = (jax.tree.leaves(after.params) for after, _ in learned)
        for x, y in zip(one, other, strict=True):
            np.testing.assert_allclose(x, y, rtol=1e-3, atol=1e-5)


def test_the_same_seed_learns_the_same_bits_and_another_does_not():
    states = []
    for seed in (0, 0, 1):
        env, network, state = setup(seed=seed)
        update = partial(UPDATE, CONFIG, env, network)
        for _ in range(3):
            state, _ = update(state)
        states.append(np.concatenate([np.ravel(x) for x in jax.tree.leaves(state.params)]))
    np.testing.assert_array_equal(states[0], states[1])
    assert (states[0] != states[2]).any()


def test_update_keeps_rank_promotion_strict():
    """`[B, 1] - [B]` would silently become `[B, B]`; the whole update is traced without it."""
    env, network, state = setup(recurrent=True)
    with jax.numpy_rank_promotion("raise"):
        UPDATE.trace(CONFIG, env, network, state)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"num_steps": 95}, ("num_steps is 95", "96", "raise num_steps")),
        ({"gamma": 1.5}, ("gamma is 1.5", "[0, 1]")),
        ({"num_envs": 0}, ("num_envs is 0", "at least 1")),
        ({"clip": 0.0}, ("clip is 0.0", "above 0")),
        ({"num_steps": 2**53 + 1}, ("num_steps is 9007199254740993", "at most 2**53")),
        ({"num_steps": 96 * 2**31}, ("2**31 updates or more", "= 96", "lower num_steps")),
        ({"shortest_episode": -1}, ("shortest_episode is -1", "0 or above")),
        ({"num_envs": 2**16, "rollout_length": 2**15}, (f"= {2**31} must be below 2**31;",)),
        ({"num_envs": 2**31 - 1}, (f"num_envs is {2**31 - 1}", "below 2**31 - 1")),
        ({"num_epochs": 2**31}, ("num_epochs", "below 2**31 - 1")),
        ({"episode_length": 2**31 - 1}, ("episode_length", "below 2**31 - 1")),
    ],
)
def test_impossible_settings_are_refused(changes, words):
    with pytest.raises(ValueError) as error:
        dataclasses.replace(CONFIG, **changes)
    for word in words:
        assert word in str(error.value)


def test_plain_ppo_lacks_what_other_trainers_lack_but_what_it_is_given():
    off = {"shortest_episode": 0, "advantage_clip": 0.0, "min_advantage_std": 0.0}
    off |= {"entropy_weight": 0.0, "entropy_target": 1.0, "reward_scaling": "constant"}
    given = {"num_steps": 10**6, "noise_color": 1.0, "schedule": "linear"}
    assert algorithm.Config.plain(**given) == algorithm.Config(**given, **off)
    assert algorithm.Config.plain(num_steps=10**6).noise_color == 0.0
    assert algorithm.Config.plain(num_steps=10**6).schedule == "constant"
    with pytest.raises(TypeError, match="gama"):
        algorithm.Config.plain(10**6, gama=0.9)


@pytest.mark.parametrize(
    "sizes",
    [
        {"num_envs": 2**16, "rollout_length": 2**15 - 1, "num_steps": 2**53},
        {"episode_length": 2**31 - 2},
        {"num_steps": 96 * (2**31 - 1), "schedule": "linear"},
    ],
)
def test_whatever_settings_are_taken_can_be_counted(sizes):
    """Traced, not computed: JAX refuses a number that it would have to turn round."""
    config = dataclasses.replace(CONFIG, num_minibatches=1, **sizes)
    start, step = (
        partial(function, config, Walk(), NETWORKS[False])
        for function in (algorithm.init, algorithm.update)
    )
    state = jax.eval_shape(start, jax.random.key(0))
    assert jax.eval_shape(step, state)[0].update.dtype == jnp.int32


@given(st.integers(1, 2**31 - 1), st.floats(0.0, 1.0, exclude_max=True))
def test_the_linear_rate_is_right_up_to_the_last_update_that_can_be_counted(updates, where):
    config = dataclasses.replace(
        CONFIG, num_envs=1, rollout_length=1, num_minibatches=1, num_steps=updates,
        schedule="linear", learning_rate=1.0,
    )  # fmt: skip
    assert config.num_updates == updates
    for update in {0, int(where * updates), updates - 1}:
        state = SimpleNamespace(update=jnp.int32(update))
        rate = float(optimizer.scheduled_rate(config, state))
        assert 0.0 <= rate <= 1.0
        assert abs(rate - (1.0 - update / updates)) < 2e-7
