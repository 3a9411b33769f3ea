"""The learner: E epochs of K minibatch steps on what an update has collected.

Clipped surrogate and value loss of Schulman et al. 2017 (arXiv:1707.06347), Adam, and a learning
rate that is constant, linear or steered by the policy's KL.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax

from purerl.core.keys import Purpose, derive
from purerl.core.records import Array, Metrics, Network, PolicyOutput, PyTree, TrainState
from purerl.devices.shards import WHOLE, Shards, each, move, numbers, total
from purerl.devices.slices import count_slices, cut_in_slices, of_slices, sum_of_slices
from purerl.ppo import losses
from purerl.ppo.batches import Batch, in_one_row, in_segments, renew
from purerl.ppo.config import Config
from purerl.ppo.losses import Scale
from purerl.ppo.rollout import select


class Learner(NamedTuple):
    """What a minibatch step changes."""

    params: PyTree
    optimizer: PyTree  # Adam's moments of all parameters
    learning_rate: Array  # []
    skipped_in_a_row: Array  # [] int32


def optimizer(config: Config) -> optax.GradientTransformation:
    """Clips by global norm, then Adam's direction; the caller multiplies by the learning rate."""
    return optax.chain(
        optax.clip_by_global_norm(config.max_gradient_norm),
        optax.scale_by_adam(eps=1e-5),
    )


def is_recurrent(carry: PyTree) -> bool:
    """Tells whether a network with this carry remembers anything."""
    return len(jax.tree.leaves(carry)) > 0


def learn(
    config: Config,
    network: Network,
    state: TrainState,
    batch: Batch,
    memory: PyTree,
    shards: Shards = WHOLE,
) -> tuple[TrainState, Metrics]:
    """E epochs of K minibatches; `memory` [B, H] is the policy's at the start of the rollout.

    Each shard shuffles its own samples, and has an equal part in every minibatch.
    """
    if config.segment_length:
        batch = move(shards, functools.partial(in_segments, config.segment_length), batch)
    elif not is_recurrent(memory):
        # One long row of samples: a minibatch is any of them, [1, M].
        batch = move(shards, in_one_row, batch)
    columns = batch.weight.shape[-1]
    rate = scheduled_rate(config, state)
    learner = Learner(state.params, state.optimizer, rate, state.skipped_in_a_row)
    key = derive(state.key, Purpose.PERMUTATION, state.update)

    def step(learner: Learner, part: tuple[Array, Scale | None]) -> tuple[Learner, Metrics]:
        index, scale = part
        minibatch, start = move(shards, _take, batch, memory, index)
        return minibatch_step(config, network, learner, minibatch, start, scale, shards)

    def epoch(learner: Learner, number: Array) -> tuple[Learner, Metrics]:
        order = shuffle(jax.random.fold_in(key, number), columns, config.num_minibatches, shards)
        scales = None if config.segment_length else scales_of_all(batch, order, shards)
        return jax.lax.scan(step, learner, (order, scales))

    learner, metrics = jax.lax.scan(epoch, learner, jnp.arange(config.num_epochs))
    state = state.replace(**learner._asdict())
    skipped = metrics.pop("skipped")
    # A skipped minibatch's figures are not finite; they must not hide the others'.
    metrics = {
        k: losses.weighted_mean(jnp.where(skipped > 0, 0.0, v), 1.0 - skipped)
        for k, v in metrics.items()
    }
    metrics |= {
        "skipped_minibatches": skipped.sum(),
        "skipped_in_a_row": learner.skipped_in_a_row.astype(jnp.float32),
        "learning_rate": learner.learning_rate,
        "parameter_norm": optax.tree.norm(learner.params),
        "explained_variance": losses.explained_variance(
            batch.old_value, batch.target, batch.weight, shards
        ),
    }
    return state, metrics


def _take(batch: Batch, memory: PyTree, index: Array) -> tuple[Batch, PyTree]:
    minibatch = jax.tree.map(lambda x: jnp.take(x, index, axis=1), batch)
    return minibatch, jax.tree.map(lambda x: jnp.take(x, index, axis=0), memory)


def scales_of_all(batch: Batch, order: Array, shards: Shards) -> Scale:
    """Returns the advantages' scales in all minibatches of an epoch, [K]: one message for them."""

    def take(x: Array, order: Array) -> Array:
        return jnp.moveaxis(jnp.take(x, order, axis=1), 1, 0)  # [K, T', M]

    if shards.number > 1:
        order = jnp.swapaxes(order, 0, 1)
    advantage, weight = (move(shards, take, x, order) for x in (batch.advantage, batch.weight))
    return losses.advantage_scale(advantage, weight, shards, several=True)


def shuffle(key: Array, columns: int, minibatches: int, shards: Shards) -> Array:
    """Returns which of a shard's columns each minibatch takes: [K, M], or [K, v, M] of shards."""
    if shards.number == 1:
        return jax.random.permutation(key, columns).reshape(minibatches, -1)

    def alone(number: Array) -> Array:
        order = jax.random.permutation(jax.random.fold_in(key, number), columns)
        return order.reshape(minibatches, -1)

    return jnp.swapaxes(move(shards, alone, numbers(shards)), 0, 1)


def scheduled_rate(config: Config, state: TrainState) -> Array:
    """Returns the learning rate that this update starts with, []."""
    if config.schedule == "constant":  # as set now, which a resumed run may have changed
        return jnp.asarray(config.learning_rate, jnp.float32)
    if config.schedule == "linear":
        progress = state.update.astype(jnp.float32) / config.num_updates
        return config.learning_rate * (1.0 - progress)
    return state.learning_rate


def unroll(network: Network, params: PyTree, batch: Batch, memory: PyTree) -> PolicyOutput:
    """Applies the network to a minibatch [T', M', ...], its memory restarted with each episode."""
    if not is_recurrent(memory):
        output, _ = network.apply(params, batch.observation, memory)
        return output

    def step(memory: PyTree, row: tuple[PyTree, Array]) -> tuple[PyTree, PolicyOutput]:
        observation, first = row
        fresh = select(first, jax.tree.map(jnp.zeros_like, memory), memory)
        output, memory = network.apply(params, observation, fresh)
        return memory, output

    _, outputs = jax.lax.scan(step, memory, (batch.observation, batch.first))
    return outputs


def loss(
    config: Config,
    network: Network,
    params: PyTree,
    scale: Scale,
    batch: Batch,
    memory: PyTree,
) -> tuple[Array, Metrics]:
    """Returns policy loss + value_weight * value loss - entropy_weight * entropy, [], metrics.

    Of one shard's part of a minibatch with the advantages' `scale`: all parts' add up to the whole.
    """
    distribution = config.action_distribution
    output = unroll(network, params, batch, memory)
    log_ratio = distribution.log_prob(output.distribution, batch.raw_action) - batch.log_prob
    advantage = losses.normalize_advantage(batch.advantage, scale)
    policy = losses.clipped_surrogate(log_ratio, advantage, config.clip)
    value = losses.value_loss(output.value, batch.old_value, batch.target, config.value_clip)
    entropy = distribution.entropy(output.distribution)
    clipped = (jnp.abs(jnp.expm1(log_ratio)) > config.clip).astype(jnp.float32)
    terms = {
        "policy_loss": policy,
        "value_loss": value,
        "entropy": entropy,
        "kl": losses.approximate_kl(log_ratio),
        "clip_fraction": clipped,
    }
    means = {k: (batch.weight * term).sum() / scale.weight for k, term in terms.items()}
    objective = (
        means["policy_loss"]
        + config.value_weight * means["value_loss"]
        - config.entropy_weight * means["entropy"]
    )
    return objective, means


def minibatch_step(
    config: Config,
    network: Network,
    learner: Learner,
    batch: Batch,
    memory: PyTree,
    scale: Scale | None,
    shards: Shards,
) -> tuple[Learner, Metrics]:
    """One gradient step, skipped and counted if any of it is not finite.

    Without a `scale` of the advantages, segments are estimated anew, and have their own.
    """
    rows, columns = batch.weight.shape[-2:]  # of one shard
    number = count_slices(rows, columns, jax.default_backend())
    batch, memory = move(shards, functools.partial(cut_in_slices, number), batch, memory)
    if scale is None:
        anew = functools.partial(renew, config, network, learner.params)
        batch = each(shards, functools.partial(of_slices, number, anew), batch, memory)
        scale = losses.advantage_scale(batch.advantage, batch.weight, shards)

    def gradient(batch: Batch, memory: PyTree) -> tuple[tuple[Array, Metrics], PyTree]:
        def objective(params: PyTree) -> tuple[Array, Metrics]:
            return loss(config, network, params, scale, batch, memory)

        return jax.value_and_grad(objective, has_aux=True)(learner.params)

    add = functools.partial(sum_of_slices, number, gradient)
    (objective, metrics), gradients = total(shards, add, batch, memory)
    norm = optax.tree.norm(gradients)
    sound = jnp.isfinite(objective) & jnp.isfinite(norm)
    updates, optimizer_state = optimizer(config).update(gradients, learner.optimizer)
    stepped = jax.tree.map(
        lambda x, u: x - (learner.learning_rate * u).astype(x.dtype), learner.params, updates
    )
    params, optimizer_state = jax.tree.map(
        lambda new, old: jnp.where(sound, new, old),
        (stepped, optimizer_state),
        (learner.params, learner.optimizer),
    )
    learner = Learner(
        params=params,
        optimizer=optimizer_state,
        learning_rate=next_rate(config, learner.learning_rate, metrics["kl"], sound),
        skipped_in_a_row=jnp.where(sound, 0, learner.skipped_in_a_row + 1),
    )
    skipped = 1.0 - sound.astype(jnp.float32)
    return learner, metrics | {"loss": objective, "gradient_norm": norm, "skipped": skipped}


def next_rate(config: Config, rate: Array, kl: Array, sound: Array) -> Array:
    """Returns the learning rate after a minibatch whose policy had moved by `kl` [].

    The adaptive schedule of Schulman et al. 2017 (section 4), applied to the learning rate: a
    factor 1.5 down above twice the desired KL, up below half of it, within [1e-5, 1e-2].
    """
    if config.schedule != "adaptive_kl":
        return rate
    down = jnp.maximum(rate / 1.5, 1e-5)
    up = jnp.minimum(rate * 1.5, 1e-2)
    moved = jnp.where(kl < 0.5 * config.desired_kl, up, rate)
    moved = jnp.where(kl > 2.0 * config.desired_kl, down, moved)
    return jnp.where(sound, moved, rate)
