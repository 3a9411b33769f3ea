"""What the losses read: a rollout with advantages and value targets."""

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
    noise: Normal | None  # [..., A] of the action, given that before; None: white
    log_prob: Array  # [...] under the policy that acted and such noise
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
    return config.reward_scale * jax.lax.rsqrt(variance + running_moments.VARIANCE_FLOOR)


def estimate(
    config: Config, state: TrainState, transitions: Transition, last_value: Array
) -> Array:
    """Returns the advantages of a rollout, [T, B]; `last_value` [B] is of what follows it."""
    value = transitions.value
    following = jnp.concatenate([value[1:], last_value[None]])
    return jax.vmap(gae, in_axes=(1, 1, 1, 1, 1, 1, None, None), out_axes=1)(
        transitions.reward * reward_factor(config, state),
        value,
        jnp.where(transitions.truncated, transitions.truncation_value, following),
        transitions.terminated,
        transitions.done,
        transitions.valid,
        config.gamma,
        config.gae_lambda,
    )


def make_batch(
    config: Config, state: TrainState, transitions: Transition, last_value: Array, first: Array
) -> Batch:
    """Computes advantages and value targets of a rollout, [T, B].

    `state` is the one after it, `last_value` [B] that of its observation, `first` [B] opens it.
    """
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
        first=jnp.concatenate([first[None], transitions.done[:-1]]),
    )


def in_one_row(samples: PyTree) -> PyTree:
    """Returns samples [T, B, ...] one after another, [1, T * B, ...]."""
    return jax.tree.map(lambda x: x.reshape(1, -1, *x.shape[2:]), samples)
