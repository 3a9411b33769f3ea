"""Evaluation: exactly N whole episodes of a fixed policy in fresh environments."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from purerl.core.env import Env, State
from purerl.core.keys import per_environment
from purerl.core.records import Array, EpisodeStats, Metrics, Network, PyTree, TrainState
from purerl.ppo import distributions, rollout
from purerl.ppo.config import Config
from purerl.ppo.noise import white


class Progress(NamedTuple):
    """What the loop over time carries, [N, ...] but for `t`."""

    t: Array  # [] int32 control steps taken
    env: State
    memory: PyTree
    episode: EpisodeStats
    over: Array  # [N] bool
    lost: Array  # [N] bool


def evaluate_policy(
    config: Config,
    env: Env,
    network: Network,
    state: TrainState,
    key: Array,
    num_episodes: int,
    deterministic: bool = True,
) -> Metrics:
    """Runs N whole episodes, each in an environment of its own, until the last one ends.

    Of `config` it reads the time limit; of `state` the parameters, the normalizer and the shape of
    a memory. `key` [] must not be one that training uses. A deterministic policy acts by its
    distribution's location, not by a sample.

    Returns:
      "episode_return", "episode_length" and every metric of the environment, name -> [N], and
      "lost" [N], 1 for an episode that ended because its state was no longer finite.

    >>> judge = functools.partial(purerl.evaluate_policy, config, env, network, num_episodes=4)
    >>> jax.jit(judge)(state, jax.random.key(2))["episode_return"].shape
    (4,)
    """
    reset_key, action_key = jax.random.split(key)

    def step(progress: Progress) -> Progress:
        output, memory = rollout.act(network, state, progress.env, progress.memory)
        raw = output.distribution.loc
        if not deterministic:
            step_key = jax.random.fold_in(action_key, progress.t)
            noise = white(step_key, jnp.arange(num_episodes), env.action_size)
            raw = distributions.sample(output.distribution, noise)
        return advance(env, progress, distributions.to_action(raw), memory)

    progress = start(config, env, state, reset_key, num_episodes)
    end = jax.lax.while_loop(lambda p: ~p.over.all(), step, progress)
    return rollout.episode_metrics(end.episode) | {
        "episode_return": end.episode.episode_return,
        "episode_length": end.episode.length.astype(jnp.float32),
        "lost": end.lost.astype(jnp.float32),
    }


def start(
    config: Config, env: Env, state: TrainState, reset_key: Array, num_episodes: int
) -> Progress:
    """Returns N episodes about to start."""
    fresh = jax.vmap(env.reset)(per_environment(reset_key, jnp.arange(num_episodes)))
    limit = jnp.full(num_episodes, config.episode_length, jnp.int32)
    never = jnp.zeros(num_episodes, bool)
    memory = rollout.start_memory(state.carry, num_episodes)
    episode, t = rollout.start_episodes(fresh, limit), jnp.zeros((), jnp.int32)
    return Progress(t, fresh, memory, episode, over=never, lost=never)


def advance(env: Env, progress: Progress, action: Array, memory: PyTree) -> Progress:
    """Takes one control step, `action` [N, A], in every episode that is not over.

    `memory` [N, ...] is the policy's after it has chosen the action.
    """
    env_state, episode = rollout.step_episodes(env, progress.env, progress.episode, action)
    lost = jax.vmap(rollout.is_lost)(env_state)
    # A lost step's reward and metrics are not numbers; its episode keeps those before it.
    episode = rollout.select(progress.over | lost, progress.episode, episode)
    ended = env_state.terminated | env_state.truncated | lost
    return Progress(
        t=progress.t + 1,
        env=rollout.select(progress.over | lost, progress.env, env_state),
        memory=rollout.select(progress.over, progress.memory, memory),
        episode=episode,
        over=progress.over | ended,
        lost=progress.lost | (lost & ~progress.over),
    )
