"""Acting in B environments for T steps: time limit, autoreset, NaN containment.

`rollout` is the only place that knows where one episode ends and the next begins.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from purerl.core.env import Env, State
from purerl.core.keys import Purpose, derive, per_environment
from purerl.core.records import Array, EpisodeStats, Metrics, Network, Normal, PyTree, TrainState
from purerl.ppo import distributions, episodes
from purerl.ppo.config import Config
from purerl.ppo.noise import action_noise


class Transition(NamedTuple):
    """One control step; a rollout is [T, B, ...]."""

    observation: PyTree  # [..., O] before the step
    raw_action: Array  # [..., A] before squashing
    # The Gaussian of the action's noise, given the noise of the steps before it; None: white noise,
    # whose Gaussian is the standard one.
    noise: Normal | None  # [..., A]
    drawn: tuple  # (noise [..., ...],), the network's own; () of one that draws none
    log_prob: Array  # [...] of the raw action, under the policy that acted, with that noise
    value: Array  # [...] V(s_t)
    reward: Array  # [...] unscaled
    discounted_return: Array  # [...] running, for reward scaling
    terminated: Array  # [...] bool
    done: Array  # [...] bool: terminated, truncated or lost; the next row is another episode
    truncated: Array  # [...] bool
    next_value: Array  # [...] V(s'_t), before any reset; another's where terminated or lost
    valid: Array  # [...] bool: False where the physics blew up
    is_first: Array  # [...] bool: an episode begins here


class RolloutState(NamedTuple):
    """What the scan over time hands from step to step, [B, ...]."""

    env_state: State
    memory: PyTree  # [B, H] the policy's, before it sees this state
    episode: EpisodeStats
    discounted_return: Array  # [B]
    sums: Metrics  # name -> [B] over the episodes that ended, and how many "resets" there were


def truncation_values(
    network: Network, state: TrainState, env_state: State, memory: PyTree, truncated: Array
) -> Array:
    """Returns V(s'_t) [B]; what stands where no episode was truncated is not to be read.

    Args:
      network: the policy and value function.
      state: for the parameters and the statistics of observations.
      env_state: [B, ...] after the step, before any reset.
      memory: [B, H] after the step.
      truncated: [B] bool.
    """

    def values() -> Array:
        return episodes.act(network, state, env_state, memory)[0].value

    # From the observation before the reset, which no batch ever holds; and only in steps where some
    # environment was truncated.
    return jax.lax.cond(truncated.any(), values, lambda: jnp.zeros(truncated.shape))


def rollout(
    config: Config, env: Env, network: Network, state: TrainState
) -> tuple[TrainState, Transition, Metrics]:
    """Acts for T steps in the environments of `state`.

    Args:
      config: the hyperparameters.
      env: the environment, unbatched.
      network: the policy and value function.
      state: of B environments, all of them or some.

    Returns:
      `state` with environments, memory and running episodes moved on; the transitions [T, B, ...];
      sums over the episodes that ended, name -> [B].
    """
    # One fresh start for each environment and update, made before the loop. Inside it, `vmap` would
    # compute a reset in every step, whether an episode ended or not. An environment whose episodes
    # end twice in an update begins again as it did before; `replayed_resets` counts that.
    reset_keys = per_environment(derive(state.key, Purpose.RESET, state.update), state.env_ids)
    fresh = jax.vmap(env.reset)(reset_keys)
    noise = action_noise(config, state, env.action_size)

    def step(now: RolloutState, t: Array) -> tuple[RolloutState, Transition]:
        drawn = episodes.draw(network, state.key, state.env_ids, state.update, t)
        return _step(config, env, network, state, fresh, now, drawn, *noise(t))

    never = jnp.zeros(state.env_ids.shape, bool)
    nothing = episodes.episode_sums(state.episode, never, never)
    places = state.env_state, state.memory, state.episode, state.discounted_return
    start = RolloutState(*places, nothing)
    # Parameters and statistics are those of `state` in every step: only `RolloutState` moves.
    end, transitions = jax.lax.scan(step, start, jnp.arange(config.rollout_length))
    output, _ = episodes.act(network, state, end.env_state, end.memory)
    state = state.replace(env_state=end.env_state, memory=end.memory, episode=end.episode)
    state = state.replace(discounted_return=end.discounted_return)
    # The next row's value is that of s'_t, unless an episode ended. Where one terminated or was
    # lost, `gae` does not read it.
    # A state that is lost in its next step is taught no value: what bootstrapped from it would rise
    # for ever. So such steps are left out: what follows the one before is a new episode's start.
    # A start that is no number has no value.
    back = lambda then, row: (jnp.where(row.valid, row.value, then), then)  # noqa: E731
    _, following = jax.lax.scan(back, jnp.nan_to_num(output.value), transitions, reverse=True)
    # Where one was truncated, its step has kept V(s'_t), whatever becomes of the next episode.
    following = jnp.where(transitions.truncated, transitions.next_value, following)
    return state, transitions._replace(next_value=following), end.sums


def _step(
    config: Config, env: Env, network: Network, state: TrainState, fresh: State, now: RolloutState,
    drawn: tuple, white: Array, noise: Normal | None,
) -> tuple[RolloutState, Transition]:  # fmt: skip
    """Acts once in every environment, and starts anew those whose episode has ended.

    Args:
      config: the hyperparameters.
      env: the environment, unbatched.
      network: the policy and value function.
      state: for the parameters and the statistics of observations, as they were before the rollout.
      fresh: [B, ...] replaces the states of episodes that end.
      now: [B, ...] before the step.
      drawn: the network's own noise, from `episodes.draw`.
      white: [B, A] standard normal noise.
      noise: [B, A] the Gaussian that the action's noise has, as `Transition` has it.
    """
    output, memory = episodes.act(network, state, now.env_state, now.memory, drawn)
    distribution = distributions.given(output.distribution, noise)
    raw = distributions.sample(distribution, white)
    action = distributions.to_action(raw)
    env_state, episode = episodes.step_episodes(env, now.env_state, now.episode, action)

    # What a lost state says of itself cannot be trusted, so it neither terminates nor truncates.
    lost = jax.vmap(episodes.is_lost)(env_state)
    terminated = env_state.terminated & ~lost
    truncated = env_state.truncated & ~lost
    done = terminated | truncated | lost
    reward = jnp.where(lost, 0.0, env_state.reward)
    discounted_return = config.gamma * now.discounted_return + reward
    # No row of the batch may hold a NaN, not even one that does not count: gradients multiply by 0,
    # and 0 times NaN is NaN. The observation before a lost step is one if a fresh start was.
    seen = now.env_state.observation, raw, distributions.log_prob(distribution, raw)
    observation, raw, log_prob = episodes.select(lost, jax.tree.map(jnp.zeros_like, seen), seen)
    transition = Transition(
        observation=observation,
        raw_action=raw,
        noise=noise,
        drawn=drawn,
        log_prob=log_prob,
        value=jnp.where(lost & ~jnp.isfinite(output.value), 0.0, output.value),
        reward=reward,
        discounted_return=discounted_return,
        terminated=terminated,
        done=done,
        truncated=truncated,
        next_value=truncation_values(network, state, env_state, memory, truncated),
        valid=~lost,
        is_first=now.episode.length == 0,
    )
    # Everything above is of the episode that the step belongs to; from here on, of the next one.
    following = RolloutState(
        env_state=episodes.select(done, fresh, env_state),
        memory=episodes.restarted(memory, done),
        episode=episodes.select(
            done,
            episodes.start_episodes(fresh, episodes.time_limits(config, state.env_ids)),
            episode,
        ),
        discounted_return=jnp.where(done, 0.0, discounted_return),
        sums=jax.tree.map(jnp.add, now.sums, episodes.episode_sums(episode, done, lost)),
    )
    return following, transition
