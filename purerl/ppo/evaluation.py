"""Evaluation: exactly N whole episodes of a fixed policy in fresh environments."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from purerl.core.env import Env, State
from purerl.core.keys import per_environment
from purerl.core.records import Array, EpisodeStats, Metrics, Network, PyTree, TrainState
from purerl.ppo import distributions, episodes
from purerl.ppo.noise import white


class Progress(NamedTuple):
    """What the loop over time carries, [N, ...] but for `t`."""

    t: Array  # [] int32 control steps taken
    env_state: State
    memory: PyTree  # [N, H] the policy's
    episode: EpisodeStats
    over: Array  # [N] bool: the episode has ended, and nothing of it changes any more
    lost: Array  # [N] bool: it ended because its state was no longer finite, or absurd


def evaluate_policy(
    env: Env,
    network: Network,
    state: TrainState,
    key: Array,
    num_episodes: int,
    episode_length: int,
    deterministic: bool = True,
) -> Metrics:
    """Runs N whole episodes, each in an environment of its own, until the last one ends.

    Args:
      env: the environment, unbatched.
      network: the policy and value function.
      state: for the parameters, the statistics of observations, and the shape of a memory.
      key: [] typed; must not be one that training uses.
      num_episodes: N.
      episode_length: time limit [control steps].
      deterministic: act by the Gaussian's `loc`, not by a sample.

    Returns:
      "episode_return", "episode_length" and every metric of the environment, name -> [N], and
      "lost" [N], 1 for an episode that ended because its state was no longer finite: what it
      counted (`*_count`) is 0.

    >>> length = config.episode_length
    >>> judge = functools.partial(purerl.evaluate_policy, env, network, episode_length=length)
    >>> judge = jax.jit(functools.partial(judge, num_episodes=4))
    >>> judge(state, jax.random.key(2))["episode_return"].shape
    (4,)
    """
    reset_key, action_key = jax.random.split(key)
    ids = jnp.arange(num_episodes)

    def step(progress: Progress) -> Progress:
        drawn = () if deterministic else episodes.draw(network, action_key, ids, progress.t)
        output, memory = episodes.act(network, state, progress.env_state, progress.memory, drawn)
        raw = output.distribution.loc
        # White, whatever the color in training: what is asked is how the policy does, and the color
        # is a way to explore.
        if not deterministic:
            noise = white(jax.random.fold_in(action_key, progress.t), ids, env.action_size)
            raw = distributions.sample(output.distribution, noise)
        return advance(env, progress, distributions.to_action(raw), memory)

    progress = start(env, state, reset_key, num_episodes, episode_length)
    # Ends with the last episode, so no episode is cut off. A mean over those that end within a
    # fixed number of steps would favour short ones.
    end = jax.lax.while_loop(lambda p: ~p.over.all(), step, progress)
    return results(end)


def results(end: Progress) -> Metrics:
    """Returns the figures of N episodes that are over, name -> [N], as `evaluate_policy`."""
    found = episodes.episode_metrics(end.episode)
    # A success may be counted from the first step on, and taken back at the end: which is missing.
    found |= {k: jnp.where(end.lost, 0.0, x) for k, x in found.items() if k.endswith("_count")}
    return found | {
        "episode_return": end.episode.episode_return,
        "episode_length": end.episode.length.astype(jnp.float32),
        "lost": end.lost.astype(jnp.float32),
    }


def start(
    env: Env, state: TrainState, reset_key: Array, num_episodes: int, episode_length: int
) -> Progress:
    """Returns N episodes about to start.

    Args:
      env: the environment, unbatched.
      state: for the shape of a memory.
      reset_key: [] typed.
      num_episodes: N.
      episode_length: time limit [control steps].
    """
    fresh = jax.vmap(env.reset)(per_environment(reset_key, jnp.arange(num_episodes)))
    limit = jnp.full(num_episodes, episode_length, jnp.int32)
    never = jnp.zeros(num_episodes, bool)
    memory = episodes.start_memory(state.memory, num_episodes)
    episode, t = episodes.start_episodes(fresh, limit), jnp.zeros((), jnp.int32)
    return Progress(t, fresh, memory, episode, over=never, lost=never)


def advance(env: Env, progress: Progress, action: Array, memory: PyTree) -> Progress:
    """Takes one control step in every episode that is not over.

    Args:
      env: the environment, unbatched.
      progress: [N, ...] before the step.
      action: [N, A].
      memory: [N, H] the policy's after it has chosen the action.
    """
    env_state, episode = episodes.step_episodes(env, progress.env_state, progress.episode, action)
    # All N environments step on to the end, also those whose episode is over: what they become is
    # dropped here.
    lost = jax.vmap(episodes.is_lost)(env_state)
    # A lost step's reward and metrics are not numbers; its episode keeps those before it.
    episode = episodes.select(progress.over | lost, progress.episode, episode)
    ended = env_state.terminated | env_state.truncated | lost
    return Progress(
        t=progress.t + 1,
        env_state=episodes.select(progress.over | lost, progress.env_state, env_state),
        memory=episodes.select(progress.over, progress.memory, memory),
        episode=episode,
        over=progress.over | ended,
        lost=progress.lost | (lost & ~progress.over),
    )
