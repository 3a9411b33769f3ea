"""What the losses read: advantages and value targets of a rollout, computed once an update."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from purerl import normalizer
from purerl.config import Config
from purerl.gae import gae
from purerl.rollout import Transition
from purerl.types import Array, PyTree, TrainState


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
