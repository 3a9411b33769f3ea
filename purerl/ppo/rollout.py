"""Acting in B environments for T steps: time limit, autoreset, NaN containment.

`rollout` is the only place that knows where one episode ends and the next begins.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from purerl.core.env import ABSURD, Env, State
from purerl.core.keys import Purpose, derive, per_environment
from purerl.core.records import (
    Array,
    EpisodeStats,
    Metrics,
    Network,
    Normal,
    PolicyOutput,
    PyTree,
    TrainState,
)
from purerl.ppo import distributions, running_moments
from purerl.ppo.config import Config
from purerl.ppo.noise import action_noise


class Transition(NamedTuple):
    """One control step; a rollout is [T, B, ...]."""

    observation: PyTree  # [..., O] before the step
    raw_action: Array  # [..., A] before squashing
    noise: Normal | None  # [..., A] its noise given that before; None: white
    log_prob: Array  # [...] of the raw action, under the policy that acted and such noise
    value: Array  # [...] V(s_t)
    reward: Array  # [...] unscaled
    discounted_return: Array  # [...] running, for reward scaling
    terminated: Array  # [...] bool
    done: Array  # [...] bool: terminated, truncated or lost; the next row is another episode
    truncated: Array  # [...] bool
    truncation_value: Array  # [...] V(s'_t) where truncated, else 0
    valid: Array  # [...] bool: False where the physics blew up


class Carry(NamedTuple):
    """What the scan over time carries, [B, ...]."""

    env: State
    memory: PyTree
    episode: EpisodeStats
    discounted_return: Array
    sums: Metrics  # name -> [B] over the episodes that ended, and how many "resets" there were


def select(condition: Array, yes: PyTree, no: PyTree) -> PyTree:
    """Returns `yes` where `condition` ([B] bool), else `no`, for every leaf [B, ...]."""

    def one(a: Array, b: Array) -> Array:
        return jnp.where(jnp.expand_dims(condition, tuple(range(1, b.ndim))), a, b)

    return jax.tree.map(one, yes, no)


def is_lost(state: State) -> Array:
    """Tells, for one environment, whether any number of its state is NaN or absurd, [] bool."""
    parts = (state.physics, state.observation, state.reward, state.metrics, state.task)
    leaves = [x for x in jax.tree.leaves(parts) if jnp.issubdtype(x.dtype, jnp.floating)]
    sound = [jnp.all(jnp.abs(x) <= ABSURD) for x in leaves]  # a NaN fails every comparison
    return ~jnp.all(jnp.stack(sound))


def act(
    network: Network, state: TrainState, env: State, memory: PyTree
) -> tuple[PolicyOutput, PyTree]:
    """Applies the network of `state` to the normalized observations of environments [B]."""
    observation = running_moments.normalize(state.normalizer, env.observation)
    return network.apply(state.params, observation, memory)


def episode_metrics(episode: EpisodeStats) -> Metrics:
    """Returns episodes' metrics [B]: the mean over their steps, or the sum for `*_count`."""
    length = jnp.maximum(episode.length, 1).astype(jnp.float32)
    return {k: x if k.endswith("_count") else x / length for k, x in episode.metrics.items()}


def start_memory(carry: PyTree, number: int) -> PyTree:
    """Returns the memory of `number` episodes about to start, like a `carry` [B, ...]: zeros."""
    return jax.tree.map(lambda x: jnp.zeros((number, *x.shape[1:]), x.dtype), carry)


def time_limits(config: Config, number: Array) -> Array:
    """Returns the time limits of training episodes, [B] int32, of environments `number` [B].

    Short episodes practise the start; a policy that never saw a long one drifts out of what it
    knows. So every environment keeps a limit of its own, from short to whole.
    """
    if not 0 < config.shortest_episode < config.episode_length:
        return jnp.full(number.shape, config.episode_length, jnp.int32)
    spaced = np.geomspace(config.shortest_episode, config.episode_length, config.num_envs)
    return jnp.asarray(np.round(spaced), jnp.int32)[number]


def start_episodes(state: State, limit: Array) -> EpisodeStats:
    """Returns the statistics of episodes about to start in `state` [B] with time limits [B]."""
    zeros = jnp.zeros(limit.shape)
    return EpisodeStats(
        episode_return=zeros,
        length=jnp.zeros(limit.shape, jnp.int32),
        limit=limit,
        metrics={name: zeros for name in state.metrics},
    )


def step_episodes(
    env: Env, state: State, episode: EpisodeStats, action: Array
) -> tuple[State, EpisodeStats]:
    """Steps environments [B] once, adds the step to their episodes, applies the time limit."""
    state = jax.vmap(env.step)(state, action)
    length = episode.length + 1
    truncated = (state.truncated | (length >= episode.limit)) & ~state.terminated
    episode = episode.replace(
        episode_return=episode.episode_return + state.reward,
        length=length,
        metrics={k: total + state.metrics[k] for k, total in episode.metrics.items()},
    )
    return state.replace(truncated=truncated), episode


def truncation_values(
    network: Network, state: TrainState, env: State, memory: PyTree, truncated: Array
) -> Array:
    """Returns V(s'_t) where `truncated` [B], else 0.

    Computed here, from the observation before the reset and the memory that goes with it, and
    only in steps where some environment was truncated: no next observation is ever stored.
    """

    def values() -> Array:
        output, _ = act(network, state, env, memory)
        return jnp.where(truncated, output.value, 0.0)  # drops those of lost environments, too

    return jax.lax.cond(truncated.any(), values, lambda: jnp.zeros(truncated.shape))


def episode_sums(episode: EpisodeStats, over: Array, lost: Array) -> Metrics:
    """Returns what each environment [B] adds to the sums of a rollout in one step.

    Its episode may be `over` [B], `lost` [B] if because its state is not finite, or absurd.
    """
    metrics = {f"episode/{name}": x for name, x in episode_metrics(episode).items()}
    ended = {"episodes": jnp.ones(over.shape), "episode_return": episode.episode_return}
    ended |= {"episode_length": episode.length.astype(jnp.float32)} | metrics
    sound = {name: jnp.where(over & ~lost, x, 0.0) for name, x in ended.items()}
    return sound | {"nonfinite_resets": lost.astype(jnp.float32), "resets": over.astype(jnp.int32)}


def rollout(
    config: Config, env: Env, network: Network, state: TrainState
) -> tuple[TrainState, Transition, Metrics, Array]:
    """Acts for T steps in the environments of `state`.

    Returns:
      `state` with environments, memory and running episodes moved on; the transitions [T, B, ...];
      sums over the episodes that ended, name -> [B]; the value of the last observation [B].
    """
    reset_keys = per_environment(derive(state.key, Purpose.RESET, state.update), state.number)
    # One start for an update, its number 0; without the fold all digests would be others.
    fresh = jax.vmap(lambda key: env.reset(jax.random.fold_in(key, 0)))(reset_keys)
    noise = action_noise(config, state, env.action_size)

    def step(carry: Carry, t: Array) -> tuple[Carry, Transition]:
        return _step(config, env, network, state, fresh, carry, *noise(t))

    never = jnp.zeros(state.number.shape, bool)
    nothing = episode_sums(state.episode, never, never)
    start = Carry(state.env, state.carry, state.episode, state.discounted_return, nothing)
    end, transitions = jax.lax.scan(step, start, jnp.arange(config.rollout_length))
    output, _ = act(network, state, end.env, end.memory)
    state = state.replace(
        env=end.env, carry=end.memory, episode=end.episode, discounted_return=end.discounted_return
    )
    return state, transitions, end.sums, output.value


def _step(
    config: Config,
    env: Env,
    network: Network,
    state: TrainState,
    fresh: State,
    carry: Carry,
    white: Array,
    noise: Normal | None,
) -> tuple[Carry, Transition]:
    """Acts once in every environment, with noise of `white` [B, A]; `fresh` replaces what ended."""
    output, memory = act(network, state, carry.env, carry.memory)
    distribution = distributions.given(output.distribution, noise)
    raw = distributions.sample(distribution, white)
    action = distributions.to_action(raw)
    env_state, episode = step_episodes(env, carry.env, carry.episode, action)

    lost = jax.vmap(is_lost)(env_state)
    terminated = env_state.terminated & ~lost
    truncated = env_state.truncated & ~lost
    over = terminated | truncated | lost
    reward = jnp.where(lost, 0.0, env_state.reward)
    discounted_return = config.gamma * carry.discounted_return + reward
    # A fresh start may itself be NaN, and 0 times NaN is no 0. A value that is a number stays:
    # the step before bootstraps from it.
    seen = carry.env.observation, raw, distributions.log_prob(distribution, raw)
    observation, raw, log_prob = select(lost, jax.tree.map(jnp.zeros_like, seen), seen)
    transition = Transition(
        observation=observation,
        raw_action=raw,
        noise=noise,
        log_prob=log_prob,
        value=jnp.where(lost & ~jnp.isfinite(output.value), 0.0, output.value),
        reward=reward,
        discounted_return=discounted_return,
        terminated=terminated,
        done=over,
        truncated=truncated,
        truncation_value=truncation_values(network, state, env_state, memory, truncated),
        valid=~lost,
    )
    following = Carry(
        env=select(over, fresh, env_state),
        memory=jax.tree.map(lambda x: select(over, jnp.zeros_like(x), x), memory),
        episode=select(over, start_episodes(fresh, time_limits(config, state.number)), episode),
        discounted_return=jnp.where(over, 0.0, discounted_return),
        sums=jax.tree.map(jnp.add, carry.sums, episode_sums(episode, over, lost)),
    )
    return following, transition
