"""However a minibatch is cut into parts, a gradient step is the same up to rounding."""

import dataclasses
from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from purerl.core.parts import WHOLE
from purerl.devices import programs, shards
from purerl.devices.shards import Shards, parts_of
from purerl.devices.slices import count_slices, cut_in_slices
from purerl.ppo import algorithm, batches, learner, running_moments
from purerl.ppo.config import Config, Evaluation
from tests import quick
from tests.ppo.test_algorithm import CONFIG, ROLLOUT, UPDATE, setup
from tests.ppo.test_running_moments import update as merge_batch

CUTS = {
    "slices": (2, parts_of(Shards(), 2)),
    "shards": (2, parts_of(Shards(2))),
    "shards in slices": (4, parts_of(Shards(2), 2)),
}
BATCH = quick.jit(batches.make_batch, static_argnums=0)
COLLECT = quick.jit(algorithm.collect, static_argnums=(0, 1, 2))


@cache
def columns(recurrent):
    """All columns of a rollout in 12 environments, [T', C], and what made them."""
    config = dataclasses.replace(CONFIG, num_envs=12)
    env, network, state = setup(config, recurrent=recurrent)
    memory = state.memory  # before the rollout
    after, transitions, _ = ROLLOUT(config, env, network, state)
    batch = BATCH(config, after, transitions)
    return config, network, after, batch if recurrent else batches.in_one_row(batch), memory


def cut(number, axis, tree):
    return jax.tree.map(lambda x: jnp.stack(jnp.split(x, number, axis)), tree)


def gradient_step(recurrent, number, parts):
    """Takes one step on all columns, cut into parts; returns the learner and its metrics."""
    config, network, state, batch, memory = columns(recurrent)

    @quick.jit
    def step(state, pieces, memories):
        begin = learner.Learner(
            state.params, state.optimizer, state.learning_rate, state.skipped_in_a_row
        )
        size = pieces.valid.shape[2]
        order = jnp.tile(jnp.arange(size), (number, 1, 1))  # one minibatch of all columns
        scale = jax.tree.map(lambda x: x[0], learner.minibatch_moments(pieces, order, parts))
        return learner.minibatch_step(config, network, {}, begin, pieces, memories, scale, parts)

    return step(state, cut(number, 1, batch), cut(number, 0, memory))


@cache
def whole_step(recurrent):
    return gradient_step(recurrent, 1, WHOLE)


@pytest.mark.slow
@pytest.mark.parametrize("name", CUTS)
@pytest.mark.parametrize("recurrent", [False, True])
def test_a_gradient_step_is_the_same_in_parts(name, recurrent):
    whole, metrics = whole_step(recurrent)
    found, others = gradient_step(recurrent, *CUTS[name])
    assert metrics["gradient_norm"] > 1e-3 and metrics.keys() == others.keys()
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-5),
        (whole.params, metrics),
        (found.params, others),
    )


def test_every_part_shuffles_its_own_columns_by_its_number():
    key = jax.random.key(2)
    order = np.asarray(learner.shuffle(key, jnp.array([0, 6]), 12, 3))
    assert order.shape == (2, 3, 4)
    assert all(set(part.ravel()) == set(range(12)) for part in order)
    assert (order[0] != order[1]).any()
    alone = learner.shuffle(key, jnp.array([6]), 12, 3)
    np.testing.assert_array_equal(order[1:], alone)


@pytest.mark.parametrize("name", CUTS)
def test_advantages_of_a_minibatch_are_scaled_by_its_own(name):
    number, parts = CUTS[name]
    shape = (number, 1, 12)
    advantage = jax.random.normal(jax.random.key(0), shape) * 3.0 + 1.0
    valid = jax.random.bernoulli(jax.random.key(1), 0.8, shape)
    batch = batches.Batch(*[advantage] * 10)._replace(valid=valid, noise=None, drawn=())
    order = learner.shuffle(jax.random.key(2), jnp.arange(number), 12, 3)
    found = learner.minibatch_moments(batch, order, parts)
    for k in range(3):
        taken = [
            np.asarray(x)[v, 0][np.asarray(order)[v, k]]
            for x in (advantage, valid)
            for v in range(number)
        ]
        values, counts = np.concatenate(taken[:number]), np.concatenate(taken[number:])
        assert found.num_samples[k] == counts.sum()
        np.testing.assert_allclose(found.mean[k], values[counts].mean(), rtol=1e-4)
        np.testing.assert_allclose(found.variance[k], values[counts].var(), rtol=1e-4)


@pytest.mark.parametrize(
    "size, changes, recurrent, platform, number",
    [
        (512, {"rollout_length": 20, "num_minibatches": 1}, False, "gpu", 16),
        (512, {"rollout_length": 20, "num_minibatches": 1}, False, "cpu", 1),
        (64, {"rollout_length": 16, "num_minibatches": 1}, False, "gpu", 4),  # 256 samples each
        (15, {"rollout_length": 17, "num_minibatches": 1}, False, "gpu", 1),
        (64, {"rollout_length": 32, "num_minibatches": 1}, True, "gpu", 8),  # whole rollouts
        (64, {"rollout_length": 320, "num_minibatches": 16}, True, "gpu", 4),  # 4 minibatches each
    ],
)
def test_slices_are_equal_and_not_too_small(size, changes, recurrent, platform, number):
    config = Config(num_steps=10**6, num_envs=size, **changes)
    assert count_slices(config, size, recurrent, platform) == number


def test_slices_hold_whole_environments():
    env, network, state = setup()
    experience = COLLECT(CONFIG, env, network, state)[1]
    sliced = cut_in_slices(3, experience)
    assert sliced.transitions.valid.shape == (3, 16, 2) and sliced.env_ids.tolist() == [
        [0, 1], [2, 3], [4, 5],
    ]  # fmt: skip
    for i in range(3):
        np.testing.assert_array_equal(
            sliced.transitions.raw_action[i],
            experience.transitions.raw_action[0, :, 2 * i : 2 * i + 2],
        )
    assert sliced.sums is experience.sums


@pytest.mark.slow
@pytest.mark.parametrize("recurrent", [False, True])
@pytest.mark.usefixtures("compiled_quickly")
def test_on_a_gpu_an_update_is_two_programs_that_make_the_same(recurrent, monkeypatch):
    env, network, state = setup(recurrent=recurrent)
    expected, metrics = UPDATE(CONFIG, env, network, state)
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    compiled = programs.compile_programs(
        CONFIG, env, network, Evaluation(number=0), False, Shards()
    )
    assert set(compiled.seconds) == {"collect", "improve"}
    updated, seen = compiled.update(jax.tree.map(jnp.copy, state))
    leaves = jax.tree.leaves((seen, updated.params, updated.optimizer, updated.env_state.physics))
    originals = jax.tree.leaves(
        (metrics, expected.params, expected.optimizer, expected.env_state.physics)
    )
    for x, y in zip(leaves, originals, strict=True):
        np.testing.assert_allclose(x, y, rtol=1e-4, atol=1e-5)


def test_on_a_gpu_minibatches_are_cut_in_slices(monkeypatch):
    asked = []
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    monkeypatch.setattr(shards, "count_slices", lambda *x: asked.append(x) or 2)
    env, network, state = setup()
    after, experience = COLLECT(CONFIG, env, network, state)
    improve = quick.jit(partial(shards.improve, CONFIG, network, Shards()))
    _, metrics = improve(after, experience)
    assert asked == [(CONFIG, 6, False, "gpu")]
    assert metrics["skipped_minibatches"] == 0 and metrics["gradient_norm"] > 0


@pytest.mark.slow
def test_pooled_moments_are_those_of_all_samples():
    samples = jax.random.normal(jax.random.key(1), (4, 5, 2)) * 3.0 + 40.0
    valid = jax.random.bernoulli(jax.random.key(2), 0.7, (4, 5)).at[1].set(False)
    start = merge_batch(running_moments.init(jnp.zeros(2)), samples[0] + 1.0, jnp.ones(5, bool))
    parts = jax.vmap(lambda x, v: running_moments.deviations(start, x, v))(samples, valid)
    pooled = running_moments.merge(start, running_moments.pool(parts))
    whole = merge_batch(start, samples.reshape(20, 2), valid.reshape(20))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-5), pooled, whole)
    assert pooled.count.low == 5 + valid.sum()
