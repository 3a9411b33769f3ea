"""What the losses read: a rollout, or segments of it, with advantages and value targets."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from purerl.core.records import Array, Network, PyTree, TrainState
from purerl.ppo import running_moments
from purerl.ppo.advantages import gae
from purerl.ppo.config import Config
from purerl.ppo.rollout import Transition


class Course(NamedTuple):
    """What happened in T steps, as advantages need it besides values, [T, B] each."""

    reward: Array  # scaled
    terminated: Array  # bool
    done: Array  # bool
    truncated: Array  # bool
    truncation_value: Array  # of the observation before the reset
    valid: Array  # bool


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
    course: Course | None = None  # [...] kept where segments are estimated anew
    following: PyTree = None  # [S, B, O] observation that follows each segment, normalized


def reward_factor(config: Config, state: TrainState) -> Array:
    """Returns what rewards are multiplied by before learning, []."""
    if config.reward_scaling == "constant":
        return jnp.asarray(config.reward_scale, jnp.float32)
    variance = state.reward_normalizer.variance.value
    return config.reward_scale * jax.lax.rsqrt(variance + running_moments.VARIANCE_FLOOR)


def estimate(
    config: Config, course: Course, value: Array, last_value: Array
) -> tuple[Array, Array]:
    """Returns advantages and value targets [T, B] of values [T, B] and what follows them, [B]."""
    following = jnp.concatenate([value[1:], last_value[None]])
    advantage = jax.vmap(gae, in_axes=(1, 1, 1, 1, 1, 1, None, None), out_axes=1)(
        course.reward,
        value,
        jnp.where(course.truncated, course.truncation_value, following),
        course.terminated,
        course.done,
        course.valid,
        config.gamma,
        config.gae_lambda,
    )
    return advantage, advantage + value


def make_batch(
    config: Config, state: TrainState, transitions: Transition, last_value: Array, first: Array
) -> Batch:
    """Computes advantages and value targets of a rollout, [T, B].

    `state` is the one after it, `last_value` [B] that of its observation, `first` [B] opens the
    rollout.
    """
    course = Course(
        reward=transitions.reward * reward_factor(config, state),
        **{name: getattr(transitions, name) for name in Course._fields[1:]},
    )
    advantage, target = estimate(config, course, transitions.value, last_value)
    batch = Batch(
        observation=running_moments.normalize(state.normalizer, transitions.observation),
        raw_action=transitions.raw_action,
        log_prob=transitions.log_prob,
        old_value=transitions.value,
        advantage=advantage,
        target=target,
        weight=transitions.valid.astype(jnp.float32),
        first=jnp.concatenate([first[None], transitions.done[:-1]]),
    )
    if not config.segment_length:
        return batch
    last = running_moments.normalize(state.normalizer, state.env.observation)
    every = config.segment_length
    following = jax.tree.map(
        lambda x, end: jnp.concatenate([x[every::every], end[None]]), batch.observation, last
    )
    return batch._replace(course=course, following=following)


def in_segments(length: int, batch: Batch) -> Batch:
    """Cuts a rollout [T, B] into segments of L steps side by side, [L, T / L * B]."""

    def cut(x: Array) -> Array:
        parts = x.reshape(-1, length, *x.shape[1:])
        return jnp.swapaxes(parts, 0, 1).reshape(length, -1, *x.shape[2:])

    following = jax.tree.map(lambda x: x.reshape(1, -1, *x.shape[2:]), batch.following)
    return jax.tree.map(cut, batch._replace(following=None))._replace(following=following)


def in_one_row(samples: PyTree) -> PyTree:
    """Returns samples [T, B, ...] one after another, [1, T * B, ...]."""
    return jax.tree.map(lambda x: x.reshape(1, -1, *x.shape[2:]), samples)


def renew(config: Config, network: Network, params: PyTree, batch: Batch, memory: PyTree) -> Batch:
    """Estimates segments [L, M] anew, from what `params` say of them and of what follows.

    The values of truncated episodes' last observations stay those of the rollout. Returns the
    samples in one row [1, L * M]: of rows, XLA made transposed copies in the loss's gradient.
    """
    assert batch.course is not None
    row = in_one_row(batch._replace(course=None, following=None))
    # Apart from each other: the loss applies the network to the first again, and XLA once for both.
    value = network.apply(params, row.observation, memory)[0].value
    last_value = network.apply(params, batch.following, memory)[0].value[0]
    value = value.reshape(batch.weight.shape)
    advantage, target = in_one_row(estimate(config, batch.course, value, last_value))
    return row._replace(advantage=advantage, target=target)
