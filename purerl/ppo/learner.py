"""The learner: E epochs of K minibatch steps on what an update has collected (PPO, section 5)."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax

from purerl.core.keys import Purpose, derive
from purerl.core.parts import Parts
from purerl.core.records import Array, Metrics, Network, PolicyOutput, PyTree, TrainState
from purerl.ppo import distributions, losses
from purerl.ppo.batches import Batch, in_one_row
from purerl.ppo.config import Config
from purerl.ppo.optimizer import next_rate, optimizer, scheduled_rate
from purerl.ppo.rollout import select
from purerl.ppo.running_moments import Moments, moments, pool


class Learner(NamedTuple):
    """What a minibatch step changes."""

    params: PyTree
    optimizer: PyTree  # Adam's moments of all parameters
    learning_rate: Array  # []
    skipped_in_a_row: Array  # [] int32


def is_recurrent(carry: PyTree) -> bool:
    """Tells whether a network with this carry remembers anything."""
    return len(jax.tree.leaves(carry)) > 0


def learn(
    config: Config,
    network: Network,
    state: TrainState,
    batch: Batch,
    memory: PyTree,
    first: Array,
    parts: Parts,
) -> tuple[TrainState, Metrics]:
    """Makes E epochs of K minibatch steps; does not read the environments in `state`.

    Each part shuffles its own samples of a rollout, [V, T, B, ...], by the number of its `first`
    environment [V], and has an equal share of every minibatch. `memory` [V, B, H] opens it.
    """
    if not is_recurrent(memory):  # then what is shuffled are single samples, else whole rollouts
        batch = jax.vmap(in_one_row)(batch)
    columns = batch.weight.shape[-1]
    rate = scheduled_rate(config, state)
    learner = Learner(state.params, state.optimizer, rate, state.skipped_in_a_row)
    key = derive(state.key, Purpose.PERMUTATION, state.update)

    def step(learner: Learner, chosen: tuple[Array, Moments]) -> tuple[Learner, Metrics]:
        index, scale = chosen
        minibatch, start = jax.vmap(take_columns)(batch, memory, index)
        return minibatch_step(config, network, learner, minibatch, start, scale, parts)

    def epoch(learner: Learner, number: Array) -> tuple[Learner, Metrics]:
        epoch_key = jax.random.fold_in(key, number)
        order = shuffle(epoch_key, first, columns, config.num_minibatches)
        scales = advantage_scales(batch, order, parts)
        return jax.lax.scan(step, learner, (jnp.swapaxes(order, 0, 1), scales))

    learner, metrics = jax.lax.scan(epoch, learner, jnp.arange(config.num_epochs))
    metrics = average_sound(metrics)
    metrics |= {
        "skipped_in_a_row": learner.skipped_in_a_row.astype(jnp.float32),
        "learning_rate": learner.learning_rate,
        "parameter_norm": optax.tree.norm(learner.params),
        "explained_variance": losses.explained_variance(
            batch.old_value, batch.target, batch.weight, parts
        ),
    }
    return state.replace(**learner._asdict()), metrics


def take_columns(batch: Batch, memory: PyTree, index: Array) -> tuple[Batch, PyTree]:
    """Returns the columns `index` [M] of one part's batch [T', ...], and their memory."""
    minibatch = jax.tree.map(lambda x: jnp.take(x, index, axis=1), batch)
    return minibatch, jax.tree.map(lambda x: jnp.take(x, index, axis=0), memory)


def shuffle(key: Array, first: Array, columns: int, minibatches: int) -> Array:
    """Returns which of its columns each of V parts gives to each minibatch, [V, K, M]."""

    def alone(number: Array) -> Array:
        order = jax.random.permutation(jax.random.fold_in(key, number), columns)
        return order.reshape(minibatches, -1)

    return jax.vmap(alone)(first)


def advantage_scales(batch: Batch, order: Array, parts: Parts) -> Moments:
    """Returns the moments of the advantages in all K minibatches of an epoch, [K]."""

    def of_each(advantage: Array, weight: Array, order: Array) -> Moments:
        advantage, weight = (jnp.take(x, order, axis=1) for x in (advantage, weight))
        return jax.vmap(moments, in_axes=1)(advantage, weight > 0)  # of [T', K, M]

    found = parts.map(of_each, batch.advantage, batch.weight, order)
    return pool(parts.gather(found))


def average_sound(metrics: Metrics) -> Metrics:
    """Averages metrics over the minibatches, [E, K] -> [], without those that were skipped.

    The figures of a skipped minibatch are not finite; they must not hide the others'.
    """
    skipped = metrics.pop("skipped")
    sound = jnp.maximum((1.0 - skipped).sum(), 1.0)
    means = {k: jnp.where(skipped > 0, 0.0, x).sum() / sound for k, x in metrics.items()}
    return means | {"skipped_minibatches": skipped.sum()}


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
    config: Config, network: Network, params: PyTree, scale: Moments, batch: Batch, memory: PyTree
) -> tuple[Array, Metrics]:
    """Returns policy loss + value_weight * value loss - entropy_weight * bonus, [], and metrics.

    Of one part of a minibatch whose advantages have the moments `scale`. Their sum over all parts
    is the minibatch's loss.
    """
    output = unroll(network, params, batch, memory)
    distribution = distributions.given(output.distribution, batch.noise)
    log_prob = distributions.log_prob(distribution, batch.raw_action)
    log_ratio = log_prob - batch.log_prob
    least, clip = config.min_advantage_std, config.advantage_clip
    advantage = losses.normalize_advantage(batch.advantage, scale, least, clip)
    terms = {
        "policy_loss": losses.clipped_surrogate(log_ratio, advantage, config.clip),
        "value_loss": losses.value_loss(output.value, batch.target),
        "entropy": distributions.entropy(output.distribution),
        "kl": losses.approximate_kl(log_ratio),
        "clip_fraction": (jnp.abs(jnp.expm1(log_ratio)) > config.clip).astype(jnp.float32),
    }
    number = jnp.maximum(scale.number.astype(jnp.float32), 1.0)
    means = {k: (batch.weight * term).sum() / number for k, term in terms.items()}
    size = batch.raw_action.shape[-1]
    bonus = losses.bounded_entropy(terms["entropy"], size, config.entropy_target)
    objective = (
        means["policy_loss"]
        + config.value_weight * means["value_loss"]
        - config.entropy_weight * (batch.weight * bonus).sum() / number
    )
    return objective, means


def minibatch_step(
    config: Config,
    network: Network,
    learner: Learner,
    batch: Batch,
    memory: PyTree,
    scale: Moments,
    parts: Parts,
) -> tuple[Learner, Metrics]:
    """Makes one gradient step; a step with a number that is not finite is skipped and counted.

    The minibatch is [V, T', M, ...], its memory [V, M, H]. `scale` is of its advantages.
    """

    def gradient(batch: Batch, memory: PyTree) -> tuple[tuple[Array, Metrics], PyTree]:
        def objective(params: PyTree) -> tuple[Array, Metrics]:
            return loss(config, network, params, scale, batch, memory)

        return jax.value_and_grad(objective, has_aux=True)(learner.params)

    (objective, metrics), gradients = parts.sum(gradient, batch, memory)
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
    rate = next_rate(config, learner.learning_rate, metrics["kl"], sound)
    in_a_row = jnp.where(sound, 0, learner.skipped_in_a_row + 1)
    learner = Learner(params, optimizer_state, rate, in_a_row)
    skipped = 1.0 - sound.astype(jnp.float32)
    return learner, metrics | {"loss": objective, "gradient_norm": norm, "skipped": skipped}
