"""Proximal policy optimisation (Schulman et al. 2017, arXiv:1707.06347).

One update, in the order you would explain it: `collect` (rollout, targets), then `improve` (E
epochs of K `minibatch_step`s, then the statistics). `init` and `update` are pure; jit each as a
whole, once.

`update` is one device's. Several devices call `collect` for each shard of the environments, and
`improve` together (`shards.py`, `spread.py`).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax

from purerl import losses, normalizer
from purerl.config import Config, check_divides
from purerl.env import Env
from purerl.keys import Purpose, derive, per_environment
from purerl.rollout import Finished, Transition, count_replays, rollout, start_episodes
from purerl.shards import WHOLE, Shards, gather, move, numbers, total
from purerl.targets import Batch, make_batch
from purerl.types import (
    Array,
    Counter,
    Metrics,
    Network,
    PolicyOutput,
    PyTree,
    TrainState,
    add_count,
    zero_count,
)

__all__ = ["Config", "collect", "improve", "init", "make_batch", "update"]


class Experience(NamedTuple):
    """What an update learns from; one shard's, or a device's shards, stacked [v, ...]."""

    batch: Batch  # [T, B]
    memory: PyTree  # [B, H] the policy's at the start of the rollout
    observations: normalizer.Moments
    returns: normalizer.Moments  # of the discounted return
    sums: Metrics  # name -> []


class Learner(NamedTuple):
    """What a minibatch step changes."""

    params: PyTree
    optimizer: PyTree
    learning_rate: Array  # []
    skipped_in_a_row: Array  # [] int32


def optimizer(config: Config) -> optax.GradientTransformation:
    """Clips by global norm, then Adam's direction; the caller multiplies by the learning rate."""
    return optax.chain(
        optax.clip_by_global_norm(config.max_gradient_norm),
        optax.scale_by_adam(eps=1e-5),
    )


def is_recurrent(carry: PyTree) -> bool:
    """Tells whether a network with this carry remembers anything."""
    return len(jax.tree.leaves(carry)) > 0


def check_sizes(config: Config, carry: PyTree, number: int = 1) -> None:
    """Raises ValueError unless the minibatches divide the rollout of each of `number` shards."""
    size, name = config.num_envs // number, "num_envs / num_shards" if number > 1 else "num_envs"
    if not is_recurrent(carry):
        size, name = size * config.rollout_length, f"{name} * rollout_length"
    check_divides(name, size, "num_minibatches", config.num_minibatches)


def init(config: Config, env: Env, network: Network, key: Array) -> TrainState:
    """Returns the state before the first update, all of it drawn from `key` [].

    Time limits of the first episodes are uniform in [1, episode_length], so that environments do
    not stay in phase: B environments all at the same moment of an episode are one sample.
    """
    params, carry = network.init(derive(key, Purpose.PARAMETERS))
    check_sizes(config, carry)
    size = config.num_envs
    env_state = jax.vmap(env.reset)(per_environment(derive(key, Purpose.FIRST_RESET), size))
    limit_keys = per_environment(derive(key, Purpose.FIRST_LIMIT), size)
    limit = jax.vmap(lambda k: jax.random.randint(k, (), 1, config.episode_length + 1))(limit_keys)
    return TrainState(
        params=params,
        optimizer=optimizer(config).init(params),
        learning_rate=jnp.asarray(config.learning_rate, jnp.float32),
        normalizer=normalizer.init(jax.tree.map(lambda x: x[0], env_state.observation)),
        reward_normalizer=normalizer.init(jnp.zeros(())),
        env=env_state,
        carry=jax.tree.map(lambda x: jnp.broadcast_to(x, (size, *x.shape)), carry),
        episode=start_episodes(env_state, limit.astype(jnp.int32)),
        discounted_return=jnp.zeros(size),
        key=key,
        update=jnp.zeros((), jnp.int32),
        steps=zero_count(),
        skipped_in_a_row=jnp.zeros((), jnp.int32),
    )


def update(
    config: Config, env: Env, network: Network, state: TrainState
) -> tuple[TrainState, Metrics]:
    """One rollout of T steps in B environments, then E epochs of K minibatches.

    Returns the next state and metrics, name -> [] float32. Observation and return statistics
    stay as they are until the end, so that the first policy ratio is exactly 1.
    """
    state, experience = collect(config, env, network, state)
    return improve(config, network, state, experience)


def collect(
    config: Config, env: Env, network: Network, state: TrainState, first: Array | int = 0
) -> tuple[TrainState, Experience]:
    """Acts for T steps in the environments of `state`, all or one shard's.

    Args:
      config: the hyperparameters.
      env: the environment.
      network: the network.
      state: with as many environments as are to act; they are moved on.
      first: number of the first of them among all.
    """
    memory, opening = state.carry, state.episode.length == 0
    state, transitions, finished, last_value = rollout(config, env, network, state, first)
    experience = Experience(
        batch=make_batch(config, state, transitions, last_value, opening),
        memory=memory,
        observations=normalizer.moments(
            state.normalizer, transitions.observation, transitions.valid
        ),
        returns=normalizer.moments(
            state.reward_normalizer, transitions.discounted_return, transitions.valid
        ),
        sums=rollout_sums(config, transitions, finished),
    )
    return state, experience


def improve(
    config: Config,
    network: Network,
    state: TrainState,
    experience: Experience,
    shards: Shards = WHOLE,
) -> tuple[TrainState, Metrics]:
    """Learns from what all shards have collected; reads nothing of the environments in `state`."""
    batch, memory, observations, returns, sums = experience
    state, learning = learn(config, network, state, batch, memory, shards)
    if shards.number > 1:
        observations, returns = map(normalizer.pool, gather(shards, (observations, returns)))
    state = state.replace(
        normalizer=normalizer.merge(state.normalizer, observations),
        reward_normalizer=normalizer.merge(state.reward_normalizer, returns),
        update=state.update + 1,
        steps=count_steps(config, state.steps),
    )
    return state, learning | rollout_metrics(total(shards, lambda x: x, sums))


def count_steps(config: Config, steps: Counter) -> Counter:
    """Adds one update's control steps."""
    return add_count(steps, jnp.asarray(config.steps_per_update, jnp.uint32))


def learn(
    config: Config,
    network: Network,
    state: TrainState,
    batch: Batch,
    memory: PyTree,
    shards: Shards = WHOLE,
) -> tuple[TrainState, Metrics]:
    """E epochs of K minibatches; `memory` [B, H] is the policy's at the start of the rollout.

    Each shard shuffles its own samples, and has an equal part in every minibatch.
    """
    if not is_recurrent(memory):
        # One long row of samples: a minibatch is any of them, [1, M].
        batch = move(shards, _in_one_row, batch)
    columns = batch.weight.shape[-1]
    learner = Learner(state.params, state.optimizer, state.learning_rate, state.skipped_in_a_row)
    learner = learner._replace(learning_rate=scheduled_rate(config, state))
    key = derive(state.key, Purpose.PERMUTATION, state.update)

    def step(learner: Learner, index: Array) -> tuple[Learner, Metrics]:
        minibatch, start = move(shards, _take, batch, memory, index)
        return minibatch_step(config, network, learner, minibatch, start, shards)

    def epoch(learner: Learner, number: Array) -> tuple[Learner, Metrics]:
        order = shuffle(jax.random.fold_in(key, number), columns, config.num_minibatches, shards)
        return jax.lax.scan(step, learner, order)

    learner, metrics = jax.lax.scan(epoch, learner, jnp.arange(config.num_epochs))
    state = state.replace(**learner._asdict())
    skipped = metrics.pop("skipped")
    # A skipped minibatch's figures are not finite; they must not hide the others'.
    metrics = {
        k: losses.weighted_mean(jnp.where(skipped > 0, 0.0, v), 1.0 - skipped)
        for k, v in metrics.items()
    }
    metrics |= {
        "skipped_minibatches": skipped.sum(),
        "skipped_in_a_row": learner.skipped_in_a_row.astype(jnp.float32),
        "learning_rate": learner.learning_rate,
        "parameter_norm": optax.tree.norm(learner.params),
        "explained_variance": losses.explained_variance(
            batch.old_value, batch.target, batch.weight, shards
        ),
    }
    return state, metrics


def _in_one_row(batch: Batch) -> Batch:
    return jax.tree.map(lambda x: x.reshape(1, -1, *x.shape[2:]), batch)


def _take(batch: Batch, memory: PyTree, index: Array) -> tuple[Batch, PyTree]:
    minibatch = jax.tree.map(lambda x: jnp.take(x, index, axis=1), batch)
    return minibatch, jax.tree.map(lambda x: jnp.take(x, index, axis=0), memory)


def shuffle(key: Array, columns: int, minibatches: int, shards: Shards) -> Array:
    """Returns which of a shard's columns each minibatch takes: [K, M], or [K, v, M] of shards."""
    if shards.number == 1:
        return jax.random.permutation(key, columns).reshape(minibatches, -1)

    def alone(number: Array) -> Array:
        order = jax.random.permutation(jax.random.fold_in(key, number), columns)
        return order.reshape(minibatches, -1)

    return jnp.swapaxes(move(shards, alone, numbers(shards)), 0, 1)


def scheduled_rate(config: Config, state: TrainState) -> Array:
    """Returns the learning rate that this update starts with, []."""
    if config.schedule == "constant":  # as set now, which a resumed run may have changed
        return jnp.asarray(config.learning_rate, jnp.float32)
    if config.schedule == "linear":
        progress = state.update.astype(jnp.float32) / config.num_updates
        return config.learning_rate * (1.0 - progress)
    return state.learning_rate


def unroll(network: Network, params: PyTree, batch: Batch, memory: PyTree) -> PolicyOutput:
    """Applies the network to a minibatch [T', M', ...], its memory restarted with each episode."""
    if not is_recurrent(memory):
        output, _ = network.apply(params, batch.observation, memory)
        return output

    def step(memory: PyTree, row: tuple[PyTree, Array]) -> tuple[PyTree, PolicyOutput]:
        observation, first = row
        fresh = jax.tree.map(
            lambda x: jnp.where(jnp.expand_dims(first, tuple(range(1, x.ndim))), 0.0, x), memory
        )
        output, memory = network.apply(params, observation, fresh)
        return memory, output

    _, outputs = jax.lax.scan(step, memory, (batch.observation, batch.first))
    return outputs


def loss(
    config: Config,
    network: Network,
    params: PyTree,
    scale: losses.Scale,
    batch: Batch,
    memory: PyTree,
) -> tuple[Array, Metrics]:
    """Returns policy loss + value_weight * value loss - entropy_weight * entropy, [], metrics.

    Of one shard's part of a minibatch with the advantages' `scale`: all parts' add up to the whole.
    """
    distribution = config.action_distribution
    output = unroll(network, params, batch, memory)
    log_ratio = distribution.log_prob(output.distribution, batch.raw_action) - batch.log_prob
    advantage = losses.normalize_advantage(batch.advantage, scale)
    policy = losses.clipped_surrogate(log_ratio, advantage, config.clip)
    value = losses.value_loss(output.value, batch.old_value, batch.target, config.value_clip)
    entropy = distribution.entropy(output.distribution)
    clipped = (jnp.abs(jnp.expm1(log_ratio)) > config.clip).astype(jnp.float32)
    terms = {
        "policy_loss": policy,
        "value_loss": value,
        "entropy": entropy,
        "kl": losses.approximate_kl(log_ratio),
        "clip_fraction": clipped,
    }
    means = {k: (batch.weight * term).sum() / scale.weight for k, term in terms.items()}
    objective = (
        means["policy_loss"]
        + config.value_weight * means["value_loss"]
        - config.entropy_weight * means["entropy"]
    )
    return objective, means


def minibatch_step(
    config: Config,
    network: Network,
    learner: Learner,
    batch: Batch,
    memory: PyTree,
    shards: Shards,
) -> tuple[Learner, Metrics]:
    """One gradient step, skipped and counted if any of it is not finite."""
    scale = losses.advantage_scale(batch.advantage, batch.weight, shards)

    def part(batch: Batch, memory: PyTree) -> tuple[tuple[Array, Metrics], PyTree]:
        def objective(params: PyTree) -> tuple[Array, Metrics]:
            return loss(config, network, params, scale, batch, memory)

        return jax.value_and_grad(objective, has_aux=True)(learner.params)

    (objective, metrics), gradients = total(shards, part, batch, memory)
    norm = optax.tree.norm(gradients)
    sound = jnp.isfinite(objective) & jnp.isfinite(norm)
    updates, optimizer_state = optimizer(config).update(gradients, learner.optimizer)
    stepped = jax.tree.map(lambda p, u: p - learner.learning_rate * u, learner.params, updates)
    params, optimizer_state = jax.tree.map(
        lambda new, old: jnp.where(sound, new, old),
        (stepped, optimizer_state),
        (learner.params, learner.optimizer),
    )
    learner = Learner(
        params=params,
        optimizer=optimizer_state,
        learning_rate=next_rate(config, learner.learning_rate, metrics["kl"], sound),
        skipped_in_a_row=jnp.where(sound, 0, learner.skipped_in_a_row + 1),
    )
    skipped = 1.0 - sound.astype(jnp.float32)
    return learner, metrics | {"loss": objective, "gradient_norm": norm, "skipped": skipped}


def next_rate(config: Config, rate: Array, kl: Array, sound: Array) -> Array:
    """Returns the learning rate after a minibatch whose policy had moved by `kl` [].

    The adaptive schedule of Schulman et al. 2017 (section 4), applied to the learning rate: a
    factor 1.5 down above twice the desired KL, up below half of it, within [1e-5, 1e-2].
    """
    if config.schedule != "adaptive_kl":
        return rate
    down = jnp.maximum(rate / 1.5, 1e-5)
    up = jnp.minimum(rate * 1.5, 1e-2)
    moved = jnp.where(kl < 0.5 * config.desired_kl, up, rate)
    moved = jnp.where(kl > 2.0 * config.desired_kl, down, moved)
    return jnp.where(sound, moved, rate)


def rollout_sums(config: Config, transitions: Transition, finished: Finished) -> Metrics:
    """Adds up what `rollout_metrics` needs over a rollout's steps and environments."""
    valid = transitions.valid.astype(jnp.float32)
    return {
        "reward": (valid * transitions.reward).sum(),
        "valid": valid.sum(),
        "episodes": finished.episodes.sum(),
        "episode_return": finished.episode_return.sum(),
        "episode_length": finished.length.sum(),
        "nonfinite_resets": finished.nonfinite_resets.sum().astype(jnp.float32),
        "replayed_resets": count_replays(config, finished.resets).astype(jnp.float32),
        **{f"episode/{name}": x.sum() for name, x in finished.metrics.items()},
    }


def rollout_metrics(sums: Metrics) -> Metrics:
    """Summarises a rollout: sums of counts, means over the episodes that ended in it."""
    sums = dict(sums)
    reward = sums.pop("reward") / jnp.maximum(sums.pop("valid"), 1.0)
    episodes = jnp.maximum(sums["episodes"], 1.0)
    means = {
        k: x / episodes for k, x in sums.items() if k.startswith("episode") and k != "episodes"
    }
    return {"reward": reward} | sums | means
