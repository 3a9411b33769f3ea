"""What the losses read: a rollout with advantages and value targets."""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp

from purerl.core.records import Array, Normal, PyTree, TrainState
from purerl.ppo import running_moments
from purerl.ppo.advantages import gae
from purerl.ppo.config import Config
from purerl.ppo.rollout import Transition


class Batch(NamedTuple):
    """What the losses read; a rollout's is [T, B, ...], a minibatch's [T', M', ...]."""

    observation: PyTree  # [..., O] normalized
    raw_action: Array  # [..., A]
    noise: Normal | None  # [..., A] of the action's noise, as `Transition` has it
    log_prob: Array  # [...] under the policy that acted, with that noise
    old_value: Array  # [...] V(s_t), of the policy that acted
    advantage: Array  # [...]
    target: Array  # [...] of the value
    # float32 of `Transition.valid`, since the losses multiply by it; where moments are computed,
    # `weight > 0` is the bool again. One bool for both would compile to another program: it waits
    # for the next change of bits.
    weight: Array  # [...] 0 where the physics blew up, else 1
    is_first: Array  # [...] bool: an episode begins here, so the memory starts from zero


def reward_factor(config: Config, state: TrainState) -> Array:
    """Returns what rewards are multiplied by before learning, [].

    Args:
      config: how rewards are scaled.
      state: for the variance of the discounted return.
    """
    if config.reward_scaling == "constant":
        return jnp.asarray(config.reward_scale, jnp.float32)
    variance = state.reward_normalizer.variance.value
    # Divided by the deviation, but not centred: a shift of rewards would change what is optimal.
    return config.reward_scale * jax.lax.rsqrt(variance + running_moments.VARIANCE_FLOOR)


def estimate(
    config: Config, state: TrainState, transitions: Transition, last_value: Array
) -> Array:
    """Returns the advantages of a rollout, [T, B].

    Args:
      config: gamma, lambda and the scale of rewards.
      state: for the scale of rewards, unbatched.
      transitions: [T, B, ...].
      last_value: [B] V of the observation that follows the rollout.
    """
    value = transitions.value
    # The next row's value is that of s'_t, unless an episode ended. Where one was truncated, the
    # rollout has kept V(s'_t). Where one terminated or was lost, `gae` does not read it.
    following = jnp.concatenate([value[1:], last_value[None]])
    of_one = functools.partial(gae, gamma=config.gamma, lambda_=config.gae_lambda)
    return jax.vmap(of_one, in_axes=1, out_axes=1)(
        transitions.reward * reward_factor(config, state),
        value,
        jnp.where(transitions.truncated, transitions.truncation_value, following),
        transitions.terminated,
        transitions.done,
        transitions.valid,
    )


def make_batch(
    config: Config, state: TrainState, transitions: Transition, last_value: Array, is_first: Array
) -> Batch:
    """Computes advantages and value targets of a rollout.

    Args:
      config: the hyperparameters.
      state: for the statistics, which are those that the policy acted by.
      transitions: [T, B, ...].
      last_value: [B] V of the observation that follows the rollout.
      is_first: [B] bool: the rollout's first step is also an episode's.

    Returns:
      The batch, [T, B, ...].
    """
    # Computed once. Through all epochs the advantages and the targets are those of the policy that
    # acted, so no gradient passes through them.
    advantage = estimate(config, state, transitions, last_value)
    return Batch(
        observation=running_moments.normalize(state.normalizer, transitions.observation),
        raw_action=transitions.raw_action,
        noise=transitions.noise,
        log_prob=transitions.log_prob,
        old_value=transitions.value,
        advantage=advantage,
        target=advantage + transitions.value,
        weight=transitions.valid.astype(jnp.float32),
        # Whatever follows a step that is done is the first of its episode.
        is_first=jnp.concatenate([is_first[None], transitions.done[:-1]]),
    )


def in_one_row(samples: PyTree) -> PyTree:
    """Returns samples [T, B, ...] one after another, [1, T * B, ...]."""
    return jax.tree.map(lambda x: x.reshape(1, -1, *x.shape[2:]), samples)
