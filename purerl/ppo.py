"""Proximal policy optimisation (Schulman et al. 2017, arXiv:1707.06347).

One update, in the order you would explain it: `rollout`, `targets`, E epochs of K
`minibatch_step`s, then the statistics. `init` and `update` are pure; jit each as a whole, once.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax

from purerl import losses, normalizer
from purerl.config import Config, check_divides
from purerl.env import Env
from purerl.gae import gae
from purerl.keys import Purpose, derive, per_environment
from purerl.rollout import Finished, Transition, rollout, start_episodes
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

__all__ = ["Config", "init", "update"]


class Batch(NamedTuple):
    """What the losses read; a rollout's is [T, B, ...], a minibatch's [T', M', ...]."""

    observation: PyTree  # [..., O] normalized
    raw_action: Array  # [..., A]
    log_prob: Array  # [...] under the policy that acted
    old_value: Array  # [...]
    advantage: Array  # [...]
    target: Array  # [...] of the value
    weight: Array  # [...] 0 where the physics blew up, else 1
    first: Array  # [...] bool: an episode begins here, so the memory starts from zero


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


def check_sizes(config: Config, carry: PyTree) -> None:
    """Raises ValueError unless the minibatches divide the rollout."""
    if is_recurrent(carry):
        check_divides("num_envs", config.num_envs, "num_minibatches", config.num_minibatches)
    else:
        whole = config.samples_per_update
        name = "num_envs * rollout_length"
        check_divides(name, whole, "num_minibatches", config.num_minibatches)


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
    memory = state.carry
    first = state.episode.length == 0
    state, transitions, finished, last_value = rollout(config, env, network, state)
    batch = make_batch(config, state, transitions, last_value, first)
    state, learning = learn(config, network, state, batch, memory)
    state = state.replace(
        normalizer=normalizer.update(state.normalizer, transitions.observation, transitions.valid),
        reward_normalizer=normalizer.update(
            state.reward_normalizer, transitions.discounted_return, transitions.valid
        ),
        update=state.update + 1,
        steps=count_steps(config, state.steps),
    )
    return state, learning | rollout_metrics(config, transitions, finished)


def count_steps(config: Config, steps: Counter) -> Counter:
    """Adds one update's control steps."""
    return add_count(steps, jnp.asarray(config.steps_per_update, jnp.uint32))


def reward_factor(config: Config, state: TrainState) -> Array:
    """Returns what rewards are multiplied by before learning, []."""
    if config.reward_scaling == "constant":
        return jnp.asarray(config.reward_scale, jnp.float32)
    variance = state.reward_normalizer.variance.value
    return config.reward_scale * jax.lax.rsqrt(variance + normalizer.VARIANCE_FLOOR)


def next_values(transitions: Transition, last_value: Array) -> Array:
    """Returns V(s'_t) [T, B]: the next row's value, or the one kept at a truncation."""
    following = jnp.concatenate([transitions.value[1:], last_value[None]])
    return jnp.where(transitions.truncated, transitions.truncation_value, following)


def make_batch(
    config: Config, state: TrainState, transitions: Transition, last_value: Array, first: Array
) -> Batch:
    """Computes advantages and value targets once, [T, B]; `first` [B] opens the rollout."""
    advantage = jax.vmap(gae, in_axes=(1, 1, 1, 1, 1, 1, None, None), out_axes=1)(
        transitions.reward * reward_factor(config, state),
        transitions.value,
        next_values(transitions, last_value),
        transitions.terminated,
        transitions.done,
        transitions.valid,
        config.gamma,
        config.gae_lambda,
    )
    return Batch(
        observation=normalizer.normalize(state.normalizer, transitions.observation),
        raw_action=transitions.raw_action,
        log_prob=transitions.log_prob,
        old_value=transitions.value,
        advantage=advantage,
        target=advantage + transitions.value,
        weight=transitions.valid.astype(jnp.float32),
        first=jnp.concatenate([first[None], transitions.done[:-1]]),
    )


def learn(
    config: Config, network: Network, state: TrainState, batch: Batch, memory: PyTree
) -> tuple[TrainState, Metrics]:
    """E epochs of K minibatches; `memory` [B, H] is the policy's at the start of the rollout."""
    recurrent = is_recurrent(memory)
    if not recurrent:
        # One long row of samples: a minibatch is any of them, [1, M].
        batch = jax.tree.map(lambda x: x.reshape(1, -1, *x.shape[2:]), batch)
    columns = batch.weight.shape[1]
    learner = Learner(state.params, state.optimizer, state.learning_rate, state.skipped_in_a_row)
    learner = learner._replace(learning_rate=scheduled_rate(config, state))
    key = derive(state.key, Purpose.PERMUTATION, state.update)

    def step(learner: Learner, index: Array) -> tuple[Learner, Metrics]:
        minibatch = jax.tree.map(lambda x: jnp.take(x, index, axis=1), batch)
        start = jax.tree.map(lambda x: jnp.take(x, index, axis=0), memory)
        return minibatch_step(config, network, learner, minibatch, start)

    def epoch(learner: Learner, number: Array) -> tuple[Learner, Metrics]:
        order = jax.random.permutation(jax.random.fold_in(key, number), columns)
        return jax.lax.scan(step, learner, order.reshape(config.num_minibatches, -1))

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
            batch.old_value, batch.target, batch.weight
        ),
    }
    return state, metrics


def scheduled_rate(config: Config, state: TrainState) -> Array:
    """Returns the learning rate that this update starts with, []."""
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
    config: Config, network: Network, params: PyTree, batch: Batch, memory: PyTree
) -> tuple[Array, Metrics]:
    """Returns policy loss + value_weight * value loss - entropy_weight * entropy, [], metrics."""
    distribution = config.action_distribution
    output = unroll(network, params, batch, memory)
    log_ratio = distribution.log_prob(output.distribution, batch.raw_action) - batch.log_prob
    advantage = losses.normalize_advantage(batch.advantage, batch.weight)
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
    means = {name: losses.weighted_mean(term, batch.weight) for name, term in terms.items()}
    total = (
        means["policy_loss"]
        + config.value_weight * means["value_loss"]
        - config.entropy_weight * means["entropy"]
    )
    return total, means


def minibatch_step(
    config: Config, network: Network, learner: Learner, batch: Batch, memory: PyTree
) -> tuple[Learner, Metrics]:
    """One gradient step, skipped and counted if any of it is not finite."""

    def objective(params: PyTree) -> tuple[Array, Metrics]:
        return loss(config, network, params, batch, memory)

    (total, metrics), gradients = jax.value_and_grad(objective, has_aux=True)(learner.params)
    norm = optax.tree.norm(gradients)
    sound = jnp.isfinite(total) & jnp.isfinite(norm)
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
    return learner, metrics | {"loss": total, "gradient_norm": norm, "skipped": skipped}


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


def rollout_metrics(config: Config, transitions: Transition, finished: Finished) -> Metrics:
    """Summarises a rollout: sums of counts, means over the episodes that ended in it."""
    episodes = finished.episodes.sum()

    def mean(total: Array) -> Array:
        return total.sum() / jnp.maximum(episodes, 1.0)

    replayed = jnp.maximum(finished.resets - config.resets_per_update, 0)
    return {
        "reward": losses.weighted_mean(transitions.reward, transitions.valid.astype(jnp.float32)),
        "episodes": episodes,
        "episode_return": mean(finished.episode_return),
        "episode_length": mean(finished.length),
        "nonfinite_resets": finished.nonfinite_resets.sum().astype(jnp.float32),
        "replayed_resets": replayed.sum().astype(jnp.float32),
        **{f"episode/{name}": mean(total) for name, total in finished.metrics.items()},
    }
