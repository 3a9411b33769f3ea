"""Acting in B environments for T steps: time limit, fresh resets, action repeat, NaN containment.

`rollout` is the only place that knows where one episode ends and the next begins.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from flax import struct

from purerl.core.env import ABSURD, Env, State
from purerl.core.keys import Purpose, derive, per_environment
from purerl.core.records import Array, EpisodeStats, Network, PolicyOutput, PyTree, TrainState
from purerl.ppo import running_moments
from purerl.ppo.config import Config
from purerl.ppo.distributions import sample
from purerl.ppo.reset_pool import draw_pool, take_from_pool


class Transition(NamedTuple):
    """One policy step; a rollout is [T, B, ...]."""

    observation: PyTree  # [..., O] before the step
    raw_action: Array  # [..., A] before squashing
    log_prob: Array  # [...] of the raw action, under the policy that acted
    value: Array  # [...] V(s_t)
    reward: Array  # [...] unscaled, summed over the action's repeats
    discounted_return: Array  # [...] running, for reward scaling
    terminated: Array  # [...] bool
    done: Array  # [...] bool: terminated, truncated or lost; the next row is another episode
    truncated: Array  # [...] bool
    truncation_value: Array  # [...] V(s'_t) where truncated, else 0
    valid: Array  # [...] bool: False where the physics blew up


class Finished(struct.PyTreeNode):
    """Sums over the episodes that ended, one environment each; also what was lost."""

    episodes: Array  # [B] float32 how many ended soundly
    episode_return: Array  # [B]
    length: Array  # [B]
    metrics: dict[str, Array]  # name -> [B], mean over (or sum of) each episode, added up
    resets: Array  # [B] int32 starts taken from the pool
    nonfinite_resets: Array  # [B] int32 episodes lost to non-finite or absurd states


class Carry(NamedTuple):
    """What the scan over time carries."""

    env: State
    memory: PyTree
    episode: EpisodeStats
    discounted_return: Array
    finished: Finished


def select(condition: Array, yes: PyTree, no: PyTree) -> PyTree:
    """Returns `yes` where `condition` ([B] bool), else `no`, for every leaf [B, ...]."""

    def one(a: Array, b: Array) -> Array:
        return jnp.where(jnp.expand_dims(condition, tuple(range(1, b.ndim))), a, b)

    return jax.tree.map(one, yes, no)


def is_lost(state: State) -> Array:
    """Tells, for one environment, whether any number of its state is NaN or absurd, [] bool."""
    parts = (state.physics, state.observation, state.reward, state.metrics, state.task)
    leaves = [x for x in jax.tree.leaves(parts) if jnp.issubdtype(x.dtype, jnp.floating)]
    # A NaN fails every comparison.
    sound = [jnp.all(jnp.abs(x) <= ABSURD) for x in leaves]
    return ~jnp.all(jnp.stack(sound))


def act(
    network: Network,
    params: PyTree,
    statistics: running_moments.Statistics,
    state: State,
    memory: PyTree,
) -> tuple[PolicyOutput, PyTree]:
    """Applies the network to the normalized observations of `state` [B]."""
    return network.apply(params, running_moments.normalize(statistics, state.observation), memory)


def episode_metric(name: str, total: Array, length: Array) -> Array:
    """Returns an episode's metric from its sum: the mean per step, or the sum for `*_count`."""
    return total if name.endswith("_count") else total / jnp.maximum(length, 1).astype(jnp.float32)


def start_memory(carry: PyTree, number: int) -> PyTree:
    """Returns the memory of `number` episodes about to start, like a `carry` [B, ...]: zeros."""
    return jax.tree.map(lambda x: jnp.zeros((number, *x.shape[1:]), x.dtype), carry)


def start_episodes(state: State, limit: Array) -> EpisodeStats:
    """Returns the statistics of episodes about to start in `state` [B] with time limits [B]."""
    zeros = jnp.zeros(limit.shape)
    return EpisodeStats(
        episode_return=zeros,
        length=jnp.zeros(limit.shape, jnp.int32),
        limit=limit,
        metrics={name: zeros for name in state.metrics},
    )


def one_control_step(
    env: Env, state: State, episode: EpisodeStats, action: Array
) -> tuple[State, EpisodeStats]:
    """Steps environments [B] once and adds the step to their episodes; applies the time limit."""
    state = jax.vmap(env.step)(state, action)
    length = episode.length + 1
    truncated = (state.truncated | (length >= episode.limit)) & ~state.terminated
    episode = episode.replace(
        episode_return=episode.episode_return + state.reward,
        length=length,
        metrics={k: total + state.metrics[k] for k, total in episode.metrics.items()},
    )
    return state.replace(truncated=truncated), episode


def repeat_step(
    config: Config, env: Env, state: State, episode: EpisodeStats, action: Array
) -> tuple[State, EpisodeStats, Array]:
    """Holds `action` [B, A] for `action_repeat` control steps; an ended episode stands still.

    Returns the states, the episodes' statistics, and the reward summed over the repeats [B].
    """
    state, episode = one_control_step(env, state, episode, action)
    if config.action_repeat == 1:
        return state, episode, state.reward

    def again(carry: tuple[State, EpisodeStats, Array], _: None) -> tuple[tuple, None]:
        state, episode, reward = carry
        over = state.terminated | state.truncated | jax.vmap(is_lost)(state)
        following = one_control_step(env, state, episode, action)
        state, episode = select(over, (state, episode), following)
        return (state, episode, jnp.where(over, reward, reward + state.reward)), None

    carry = (state, episode, state.reward)
    carry, _ = jax.lax.scan(again, carry, length=config.action_repeat - 1)
    return carry


def truncation_values(
    network: Network,
    params: PyTree,
    statistics: running_moments.Statistics,
    state: State,
    memory: PyTree,
    truncated: Array,
) -> Array:
    """Returns V(s'_t) where `truncated` [B], else 0.

    Computed here, from the observation before the reset and the memory that goes with it, and
    only in steps where some environment was truncated: no next observation is ever stored.
    """

    def values() -> Array:
        output, _ = act(network, params, statistics, state, memory)
        # `where` also drops the values of environments that are lost.
        return jnp.where(truncated, output.value, 0.0)

    return jax.lax.cond(truncated.any(), values, lambda: jnp.zeros(truncated.shape))


def count_finished(finished: Finished, episode: EpisodeStats, over: Array, lost: Array) -> Finished:
    """Adds the episodes that are `over` [B] soundly, and counts the `lost` [B]."""
    sound = over & ~lost

    def add(total: Array, x: Array | float) -> Array:
        return total + jnp.where(sound, x, 0.0)

    metrics = {
        name: add(total, episode_metric(name, episode.metrics[name], episode.length))
        for name, total in finished.metrics.items()
    }
    return Finished(
        episodes=add(finished.episodes, 1.0),
        episode_return=add(finished.episode_return, episode.episode_return),
        length=add(finished.length, episode.length.astype(jnp.float32)),
        metrics=metrics,
        resets=finished.resets + over.astype(jnp.int32),
        nonfinite_resets=finished.nonfinite_resets + lost.astype(jnp.int32),
    )


def nothing_finished(state: State) -> Finished:
    """Returns empty sums for environments `state` [B]."""
    zeros = jnp.zeros(state.reward.shape)
    none = jnp.zeros(state.reward.shape, jnp.int32)
    return Finished(
        episodes=zeros,
        episode_return=zeros,
        length=zeros,
        metrics={name: zeros for name in state.metrics},
        resets=none,
        nonfinite_resets=none,
    )


def rollout(
    config: Config, env: Env, network: Network, state: TrainState, first: Array | int = 0
) -> tuple[TrainState, Transition, Finished, Array]:
    """Acts for T steps in the environments of `state`, which are number `first` and following.

    Returns `state` with environments, memory and running episodes moved on, the transitions
    [T, B, ...], the episodes that finished, and the value of the last observation [B].
    """
    size = state.discounted_return.shape[0]
    pool = draw_pool(config, env, derive(state.key, Purpose.RESET, state.update), size, first)
    action_key = derive(state.key, Purpose.ACTION, state.update)

    def step(carry: Carry, t: Array) -> tuple[Carry, Transition]:
        keys = per_environment(jax.random.fold_in(action_key, t), size, first)
        return _policy_step(config, env, network, state, pool, carry, keys)

    start = Carry(
        env=state.env,
        memory=state.carry,
        episode=state.episode,
        discounted_return=state.discounted_return,
        finished=nothing_finished(state.env),
    )
    end, transitions = jax.lax.scan(step, start, jnp.arange(config.rollout_length))
    output, _ = act(network, state.params, state.normalizer, end.env, end.memory)
    state = state.replace(
        env=end.env,
        carry=end.memory,
        episode=end.episode,
        discounted_return=end.discounted_return,
    )
    return state, transitions, end.finished, output.value


def _policy_step(
    config: Config,
    env: Env,
    network: Network,
    state: TrainState,
    pool: State,
    carry: Carry,
    keys: Array,
) -> tuple[Carry, Transition]:
    """Acts once in every environment, with noise from `keys` [B]; resets those that ended."""
    distribution = config.action_distribution
    output, memory = act(network, state.params, state.normalizer, carry.env, carry.memory)
    noise = jax.vmap(lambda key: jax.random.normal(key, (env.action_size,)))(keys)
    raw = sample(output.distribution, noise)
    action = distribution.to_action(raw)
    env_state, episode, reward = repeat_step(config, env, carry.env, carry.episode, action)

    lost = jax.vmap(is_lost)(env_state)
    terminated = env_state.terminated & ~lost
    truncated = env_state.truncated & ~lost
    over = terminated | truncated | lost
    reward = jnp.where(lost, 0.0, reward)
    discounted_return = config.gamma * carry.discounted_return + reward
    truncation_value = truncation_values(
        network, state.params, state.normalizer, env_state, memory, truncated
    )
    # A fresh start may itself be NaN, and 0 times NaN is no 0.
    seen = carry.env.observation, raw, distribution.log_prob(output.distribution, raw), output.value
    observation, raw, log_prob, value = select(lost, jax.tree.map(jnp.zeros_like, seen), seen)
    transition = Transition(
        observation=observation,
        raw_action=raw,
        log_prob=log_prob,
        value=value,
        reward=reward,
        discounted_return=discounted_return,
        terminated=terminated,
        done=over,
        truncated=truncated,
        truncation_value=truncation_value,
        valid=~lost,
    )
    fresh = take_from_pool(pool, carry.finished.resets)
    limit = jnp.full(over.shape, config.episode_length, jnp.int32)
    following = Carry(
        env=select(over, fresh, env_state),
        memory=jax.tree.map(lambda x: select(over, jnp.zeros_like(x), x), memory),
        episode=select(over, start_episodes(fresh, limit), episode),
        discounted_return=jnp.where(over, 0.0, discounted_return),
        finished=count_finished(carry.finished, episode, over, lost),
    )
    return following, transition
