"""What the losses read: a rollout with advantages and value targets."""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp

from purerl.core.records import Array, Normal, PyTree, TrainState
from purerl.ppo import advantages, rollout, running_moments
from purerl.ppo.config import Config


class Batch(NamedTuple):
    """What the losses read; a rollout's is [T, B, ...], a minibatch's [T', M', ...].

    A field that `Transition` has too is that of the rollout.
    """

    observation: PyTree  # [..., O] normalized
    raw_action: Array  # [..., A]
    noise: Normal | None  # [..., A] of the action's noise, as `Transition` has it
    drawn: tuple  # of the network's own noise, as `Transition` has it
    log_prob: Array  # [...] under the policy that acted, with that noise
    value: Array  # [...] V(s_t), of the policy that acted
    advantage: Array  # [...]
    target: Array  # [...] of the value
    valid: Array  # [...] bool: False where the physics blew up
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


def make_batch(config: Config, state: TrainState, transitions: rollout.Transition) -> Batch:
    """Computes advantages and value targets of a rollout.

    Args:
      config: the hyperparameters.
      state: for the statistics: of observations, those that the policy acted by; of returns, those
        that have this rollout.
      transitions: [T, B, ...].

    Returns:
      The batch, [T, B, ...].
    """
    of_one = functools.partial(advantages.gae, gamma=config.gamma, lambda_=config.gae_lambda)
    # Computed once. Through all epochs the advantages and the targets are those of the policy that
    # acted, so no gradient passes through them.
    seen = transitions._asdict()
    reward = transitions.reward * reward_factor(config, state)
    judged = [seen[name] for name in ("value", "next_value", "terminated", "done", "valid")]
    advantage = jax.vmap(of_one, in_axes=1, out_axes=1)(reward, *judged)
    seen["observation"] = running_moments.normalize(state.normalizer, transitions.observation)
    seen |= {"advantage": advantage, "target": advantage + transitions.value}
    return Batch(**{name: seen[name] for name in Batch._fields})


def in_one_row(samples: PyTree) -> PyTree:
    """Returns samples [T, B, ...] one after another, [1, T * B, ...]."""
    return jax.tree.map(lambda x: x.reshape(1, -1, *x.shape[2:]), samples)
