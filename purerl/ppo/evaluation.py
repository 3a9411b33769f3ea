"""Evaluation: exactly N whole episodes of a fixed policy in fresh environments."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from purerl.core.env import Env, State
from purerl.core.keys import Purpose, derive, per_environment
from purerl.core.records import Array, EpisodeStats, Metrics, Network, PyTree, TrainState
from purerl.ppo.config import Config
from purerl.ppo.distributions import sample
from purerl.ppo.rollout import (
    act,
    episode_metric,
    is_lost,
    repeat_step,
    select,
    start_episodes,
    start_memory,
)


class Progress(NamedTuple):
    """What the loop over time carries, [N, ...] but for `t`."""

    t: Array  # [] int32 policy steps taken
    env: State
    memory: PyTree
    episode: EpisodeStats
    over: Array  # [N] bool
    lost: Array  # [N] bool


def evaluate(
    config: Config,
    env: Env,
    network: Network,
    state: TrainState,
    key: Array,
    num_episodes: int,
    deterministic: bool = True,
) -> Metrics:
    """Runs N whole episodes, each in an environment of its own, until the last one ends.

    Args:
      config: for the time limit, the action repeat and the distribution.
      env: the environment.
      network: the network.
      state: for `params` and `normalizer`, and the shape of one environment's memory.
      key: [] typed; must not be one that training uses.
      num_episodes: N.
      deterministic: act by the distribution's location instead of a sample.

    Returns:
      "episode_return", "episode_length" and every metric of the environment, name -> [N], and
      "lost" [N], 1 for an episode that ended because its state was no longer finite.
    """
    reset_key, action_key = jax.random.split(key)
    progress = start(config, env, state, reset_key, num_episodes)

    def step(progress: Progress) -> Progress:
        keys = per_environment(jax.random.fold_in(action_key, progress.t), num_episodes)
        return _step(config, env, network, state, progress, keys, deterministic)

    end = jax.lax.while_loop(lambda p: ~p.over.all(), step, progress)
    episode = end.episode
    metrics = {k: episode_metric(k, v, episode.length) for k, v in episode.metrics.items()}
    return metrics | {
        "episode_return": episode.episode_return,
        "episode_length": episode.length.astype(jnp.float32),
        "lost": end.lost.astype(jnp.float32),
    }


def start(
    config: Config, env: Env, state: TrainState, reset_key: Array, num_episodes: int
) -> Progress:
    """Returns N episodes about to start."""
    fresh = jax.vmap(env.reset)(per_environment(reset_key, num_episodes))
    limit = jnp.full(num_episodes, config.episode_length, jnp.int32)
    never = jnp.zeros(num_episodes, bool)
    return Progress(
        t=jnp.zeros((), jnp.int32),
        env=fresh,
        memory=start_memory(state.carry, num_episodes),
        episode=start_episodes(fresh, limit),
        over=never,
        lost=never,
    )


def evaluate_in_run(
    config: Config, env: Env, network: Network, num_episodes: int, state: TrainState
) -> Metrics:
    """Evaluates the deterministic policy on episodes that depend on seed and update alone."""
    key = derive(state.key, Purpose.EVALUATION, state.update)
    return evaluate(config, env, network, state, key, num_episodes)


def _step(
    config: Config,
    env: Env,
    network: Network,
    state: TrainState,
    progress: Progress,
    keys: Array,
    deterministic: bool,
) -> Progress:
    """Acts once in every episode; one that is over stands still."""
    output, memory = act(network, state.params, state.normalizer, progress.env, progress.memory)
    raw = output.distribution.loc
    if not deterministic:
        noise = jax.vmap(lambda key: jax.random.normal(key, (env.action_size,)))(keys)
        raw = sample(output.distribution, noise)
    action = config.action_distribution.to_action(raw)
    return advance(config, env, progress, action, memory)[0]


def advance(
    config: Config, env: Env, progress: Progress, action: Array, memory: PyTree
) -> tuple[Progress, Array]:
    """Takes `action` [N, A] in every episode that is not over; returns the rewards [N] too.

    `memory` is the policy's after it has chosen the action.
    """
    env_state, episode, reward = repeat_step(config, env, progress.env, progress.episode, action)
    lost = jax.vmap(is_lost)(env_state)
    # A lost step's reward and metrics are not numbers; its episode keeps those before it.
    episode = select(progress.over | lost, progress.episode, episode)
    ended = env_state.terminated | env_state.truncated | lost
    after = Progress(
        t=progress.t + 1,
        env=select(progress.over | lost, progress.env, env_state),
        memory=select(progress.over, progress.memory, memory),
        episode=episode,
        over=progress.over | ended,
        lost=progress.lost | (lost & ~progress.over),
    )
    return after, reward
