"""Episodes, many at a time: how they start, how a policy acts in them, how they end.

Training and evaluation share these functions, so an episode is the same thing in both.
"""

import jax
import jax.numpy as jnp
import numpy as np

from purerl.core.env import ABSURD, Env, State
from purerl.core.keys import Purpose, derive, per_environment
from purerl.core.records import Array, EpisodeStats, Network, PolicyOutput, PyTree, TrainState
from purerl.ppo import running_moments
from purerl.ppo.config import Config


def time_limits(config: Config, env_ids: Array) -> Array:
    """Returns the time limits of training episodes, [B] int32.

    Short episodes practise the start; a policy that never saw a long one drifts out of what it
    knows. So every environment keeps a limit of its own, from short to whole.

    Args:
      config: the shortest limit, and the whole one.
      env_ids: [B] int32.
    """
    if config.num_envs == 1 or not 0 < config.shortest_episode < config.episode_length:
        return jnp.full(env_ids.shape, config.episode_length, jnp.int32)
    # Spaced over all environments, of which those of `env_ids` may be a part.
    spaced = np.geomspace(config.shortest_episode, config.episode_length, config.num_envs)
    return jnp.asarray(np.round(spaced), jnp.int32)[env_ids]


def start_episodes(env_state: State, limit: Array) -> EpisodeStats:
    """Returns the statistics of episodes about to start.

    Args:
      env_state: [B, ...], for the names of its metrics.
      limit: [B] int32 time limits [control steps].
    """
    zeros = jnp.zeros(limit.shape)
    return EpisodeStats(
        episode_return=zeros,
        length=jnp.zeros(limit.shape, jnp.int32),
        limit=limit,
        metrics={name: zeros for name in env_state.metrics},
    )


def start_memory(memory: PyTree, num_episodes: int) -> PyTree:
    """Returns the memory of episodes about to start, zeros [N, H].

    Args:
      memory: any memory of the same network, [B, H]; only its shapes are read.
      num_episodes: N.
    """
    return jax.tree.map(lambda x: jnp.zeros((num_episodes, *x.shape[1:]), x.dtype), memory)


def restarted(memory: PyTree, begins: Array) -> PyTree:
    """Returns a memory [B, H] that starts from zero where an episode begins, `begins` [B] bool."""
    return select(begins, jax.tree.map(jnp.zeros_like, memory), memory)


def draw(network: Network, key: Array, env_ids: Array, *indices: Array) -> tuple:
    """Returns the network's own noise as what `act` takes: (noise [B, ...],), or () if it has none.

    Args:
      network: the policy and value function.
      key: [] typed, that `indices` of [] each are folded into.
      env_ids: [B] int32.
    """
    # No key is made for others: what a loop over time does not read, it would compute all the same.
    if network.draw is None:
        return ()
    keys = per_environment(derive(key, Purpose.NETWORK, *indices), env_ids)
    return (jax.vmap(network.draw)(keys),)


def act(
    network: Network, state: TrainState, env_state: State, memory: PyTree, drawn: tuple = ()
) -> tuple[PolicyOutput, PyTree]:
    """Applies the network to the normalized observations of environments.

    Args:
      network: the policy and value function.
      state: for the parameters and the statistics of observations, both unbatched.
      env_state: [B, ...] what to look at.
      memory: [B, H] the policy's, before it looks.
      drawn: its own noise, from `draw`; (): it acts by the mean.

    Returns:
      The policy's Gaussian [B, A] and the value [B], and the memory [B, H] that follows.
    """
    observation = running_moments.normalize(state.normalizer, env_state.observation)
    return network.apply(state.params, observation, memory, *drawn)


def step_episodes(
    env: Env, env_state: State, episode: EpisodeStats, action: Array
) -> tuple[State, EpisodeStats]:
    """Steps environments once, adds the step to their episodes, applies the time limit.

    Args:
      env: the environment, unbatched.
      env_state: [B, ...].
      episode: [B] up to this step.
      action: [B, A].
    """
    env_state = jax.vmap(env.step)(env_state, action)
    length = episode.length + 1
    # A step may do both. Terminated wins: after it there is nothing to bootstrap from.
    truncated = (env_state.truncated | (length >= episode.limit)) & ~env_state.terminated
    episode = episode.replace(
        episode_return=episode.episode_return + env_state.reward,
        length=length,
        metrics={k: total + env_state.metrics[k] for k, total in episode.metrics.items()},
    )
    return env_state.replace(truncated=truncated), episode


def is_lost(state: State) -> Array:
    """Tells, for one environment, unbatched, whether a number of its state is NaN or absurd, []."""
    watched = (state.physics, state.observation, state.reward, state.metrics, state.task)
    # All that the next step and the learner will read. Integers cannot be NaN.
    leaves = [x for x in jax.tree.leaves(watched) if jnp.issubdtype(x.dtype, jnp.floating)]
    sound = [jnp.all(jnp.abs(x) <= ABSURD) for x in leaves]  # a NaN fails every comparison
    return ~jnp.all(jnp.stack(sound))


def episode_metrics(episode: EpisodeStats) -> dict[str, Array]:
    """Returns episodes' metrics [B]: the mean over their steps, or the sum for `*_count`."""
    # At least 1, because an episode that has just begun has no step.
    length = jnp.maximum(episode.length, 1).astype(jnp.float32)
    return {k: x if k.endswith("_count") else x / length for k, x in episode.metrics.items()}


def episode_sums(episode: EpisodeStats, done: Array, lost: Array) -> dict[str, Array]:
    """Returns what each environment adds to the sums of a rollout in one step, name -> [B].

    Args:
      episode: [B] after the step.
      done: [B] bool: the step ended the episode.
      lost: [B] bool: it did because the state is not finite, or absurd.
    """
    metrics = {f"episode/{name}": x for name, x in episode_metrics(episode).items()}
    ended = {"episodes": jnp.ones(done.shape), "episode_return": episode.episode_return}
    ended |= {"episode_length": episode.length.astype(jnp.float32)} | metrics
    # A lost episode has no return: it counts as a reset, and in no mean over episodes.
    sound = {name: jnp.where(done & ~lost, x, 0.0) for name, x in ended.items()}
    return sound | {"nonfinite_resets": lost.astype(jnp.float32), "resets": done.astype(jnp.int32)}


def select(condition: Array, yes: PyTree, no: PyTree) -> PyTree:
    """Returns `yes` where the condition holds, else `no`.

    Args:
      condition: [B] bool.
      yes: leaves [B, ...].
      no: leaves [B, ...], of the same structure.
    """

    def one(a: Array, b: Array) -> Array:
        # Unlike `where` it refuses other shapes and dtypes, as of a `step` unlike its `reset`.
        return jax.lax.select(jax.lax.broadcast_in_dim(condition, b.shape, (0,)), a, b)

    return jax.tree.map(one, yes, no)
