"""The learner: E epochs of K minibatch steps on what an update has collected (PPO, section 5).

What is shuffled are columns. Of a feed-forward network, a column is one sample: the rollout is laid
out in one row, T' = 1. Of a recurrent one, it is the whole rollout of one environment, T' = T.
Everything is computed by parts, [V, ...], as `core/parts.py` says.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax

from purerl.core.keys import Purpose, derive, per_environment
from purerl.core.parts import Parts
from purerl.core.records import Array, Metrics, Network, PolicyOutput, PyTree, TrainState
from purerl.ppo import distributions, episodes, losses
from purerl.ppo.batches import Batch, in_one_row
from purerl.ppo.config import Config
from purerl.ppo.optimizer import auxiliary_weights, next_rate, optimizer, scheduled_rate
from purerl.ppo.running_moments import Moments, moments_of, pool


class Learner(NamedTuple):
    """What a minibatch step changes; fields of `TrainState`, by their names there."""

    params: PyTree
    optimizer: PyTree  # Adam's moments of all parameters
    learning_rate: Array  # []
    skipped_in_a_row: Array  # [] int32


def is_recurrent(memory: PyTree) -> bool:
    """Tells whether a network with this memory remembers anything."""
    return len(jax.tree.leaves(memory)) > 0


def learn(
    config: Config,
    network: Network,
    state: TrainState,
    batch: Batch,
    memory: PyTree,
    part_ids: Array,
    parts: Parts,
) -> tuple[TrainState, Metrics]:
    """Makes E epochs of K minibatch steps.

    Each part shuffles its own columns, and has an equal share of every minibatch.

    Args:
      config: the hyperparameters.
      network: the policy and value function.
      state: for what is learned, the key and the update; its environments are not read.
      batch: [V, T, B, ...] a rollout.
      memory: [V, B, H] the policy's at the rollout's start.
      part_ids: [V] int32 the id of each part's first environment, for its shuffling.
      parts: how the V parts are computed.

    Returns:
      `state` with what was learned, and metrics, name -> [].
    """
    if not is_recurrent(memory):
        batch = jax.vmap(in_one_row)(batch)
    num_columns = batch.valid.shape[-1]
    rate = scheduled_rate(config, state)
    learner = Learner(state.params, state.optimizer, rate, state.skipped_in_a_row)
    key = derive(state.key, Purpose.PERMUTATION, state.update)
    weights = auxiliary_weights(config, state)

    def step(learner: Learner, chosen: tuple[Array, Moments]) -> tuple[Learner, Metrics]:
        index, moments = chosen
        minibatch, start = jax.vmap(take_columns)(batch, memory, index)
        return minibatch_step(config, network, weights, learner, minibatch, start, moments, parts)

    def epoch(learner: Learner, epoch_id: Array) -> tuple[Learner, Metrics]:
        epoch_key = jax.random.fold_in(key, epoch_id)
        order = shuffle(epoch_key, part_ids, num_columns, config.num_minibatches)
        # Advantages are constants of the whole update, so their moments in all K minibatches are
        # known before the first step. Pooled here, they cost the parts one message for an epoch;
        # inside the scan it would be one more for each step.
        scales = minibatch_moments(batch, order, parts)
        return jax.lax.scan(step, learner, (jnp.swapaxes(order, 0, 1), scales))

    learner, metrics = jax.lax.scan(epoch, learner, jnp.arange(config.num_epochs))
    metrics = average_sound(metrics) | {
        "skipped_in_a_row": learner.skipped_in_a_row.astype(jnp.float32),
        "learning_rate": learner.learning_rate,
        "parameter_norm": optax.tree.norm(learner.params),
    }
    metrics |= {f"auxiliary/{name}_weight": x for name, x in weights.items()}
    explained = losses.explained_variance(batch.value, batch.target, batch.valid, parts)
    return state.replace(**learner._asdict()), metrics | {"explained_variance": explained}


def take_columns(batch: Batch, memory: PyTree, index: Array) -> tuple[Batch, PyTree]:
    """Returns some columns of one part's batch, [T', M, ...], and their memory, [M, H].

    Args:
      batch: [T', C, ...] of one part, of C columns.
      memory: [B, H] at the rollout's start; of a feed-forward network, ().
      index: [M] int32 which columns.
    """
    # Where there is a memory, columns are environments, so one index serves both.
    minibatch = jax.tree.map(lambda x: jnp.take(x, index, axis=1), batch)
    return minibatch, jax.tree.map(lambda x: jnp.take(x, index, axis=0), memory)


def shuffle(key: Array, part_ids: Array, num_columns: int, num_minibatches: int) -> Array:
    """Returns which of its columns each of V parts gives to each minibatch, [V, K, M].

    Args:
      key: [] typed, of the epoch.
      part_ids: [V] int32. A part's order depends on its own id alone, so it is the same wherever
        the part is computed.
      num_columns: columns of one part, a multiple of K.
      num_minibatches: K.
    """
    keys = per_environment(key, part_ids)
    order = jax.vmap(lambda key: jax.random.permutation(key, num_columns))(keys)
    return order.reshape(len(part_ids), num_minibatches, -1)


def minibatch_moments(batch: Batch, order: Array, parts: Parts) -> Moments:
    """Returns the moments of the advantages in all K minibatches of an epoch, [K].

    Args:
      batch: [V, T', C, ...] of C columns in each part.
      order: [V, K, M] which columns are in which minibatch.
      parts: how the V parts are computed.
    """

    def of_each(advantage: Array, valid: Array, order: Array) -> Moments:
        advantage, valid = (jnp.take(x, order, axis=1) for x in (advantage, valid))
        return jax.vmap(moments_of, in_axes=1)(advantage, valid)  # of [T', K, M]

    found = parts.map(of_each, batch.advantage, batch.valid, order)
    return pool(parts.gather(found))


def average_sound(metrics: Metrics) -> Metrics:
    """Averages metrics over the minibatches, [E, K] -> [], without those that were skipped."""
    skipped = metrics["skipped"]
    sound = jnp.maximum((1.0 - skipped).sum(), 1.0)
    # `where`, not a product, for the figures of a skipped minibatch are NaN or infinite.
    others = {k: x for k, x in metrics.items() if k != "skipped"}
    means = {k: jnp.where(skipped > 0, 0.0, x).sum() / sound for k, x in others.items()}
    return means | {"skipped_minibatches": skipped.sum()}


def unroll(network: Network, params: PyTree, batch: Batch, memory: PyTree) -> PolicyOutput:
    """Applies the network to one part of a minibatch, its memory restarted with each episode.

    Args:
      network: the policy and value function.
      params: its parameters, unbatched.
      batch: [T', M, ...].
      memory: [M, H] at the rollout's start, which the policy of that time had computed.

    Returns:
      Gaussians and values, [T', M, ...].
    """
    more = {"is_first": batch.is_first} if getattr(network.apply, "sequences", False) else {}
    if more or not is_recurrent(memory):
        return network.apply(params, batch.observation, memory, *batch.drawn, **more)[0]

    # Backpropagation through time reaches back to the rollout's first step and stops there: the
    # memory at that step is data, and of older parameters.
    def step(memory: PyTree, row: tuple[PyTree, Array, tuple]) -> tuple[PyTree, PolicyOutput]:
        observation, is_first, drawn = row
        fresh = episodes.restarted(memory, is_first)
        output, memory = network.apply(params, observation, fresh, *drawn)
        return memory, output

    _, outputs = jax.lax.scan(step, memory, (batch.observation, batch.is_first, batch.drawn))
    return outputs


def loss(
    config: Config, output: PolicyOutput, advantage_moments: Moments, batch: Batch
) -> tuple[Array, Metrics]:
    """Returns policy loss + value_weight * value loss - entropy_weight * bonus, [], and metrics.

    Each is one part's share: the sum over all parts is the minibatch's.

    Args:
      config: the hyperparameters.
      output: [T', M, ...] what the network says now of the batch's observations.
      advantage_moments: of the whole minibatch, all parts together, [] each.
      batch: [T', M, ...] one part of the minibatch.
    """
    distribution = distributions.given(output.distribution, batch.noise)
    log_prob = distributions.log_prob(distribution, batch.raw_action)
    log_ratio = log_prob - batch.log_prob  # 0 in the first step: the statistics have not moved
    least, clip = config.min_advantage_std, config.advantage_clip
    advantage = losses.normalize_advantage(batch.advantage, advantage_moments, least, clip)
    terms = {
        "policy_loss": losses.clipped_surrogate(log_ratio, advantage, config.clip),
        "value_loss": losses.value_loss(output.value, batch.target),
        "entropy": distributions.entropy(output.distribution),
        "kl": losses.approximate_kl(log_ratio),
        "clip_fraction": (jnp.abs(jnp.expm1(log_ratio)) > config.clip).astype(jnp.float32),
    }
    # Over all parts' samples, not this one's: so shares of a mean add up to the mean.
    count = jnp.maximum(advantage_moments.num_samples.astype(jnp.float32), 1.0)
    entropy, size = terms["entropy"], batch.raw_action.shape[-1]
    terms |= {f"auxiliary/{name}": x for name, x in output.losses.items()}
    terms["bonus"] = losses.bounded_entropy(entropy, size, config.entropy_target)
    means = {k: jnp.where(batch.valid, x, 0.0).sum() / count for k, x in terms.items()}
    objective = means["policy_loss"] + config.value_weight * means["value_loss"]
    return objective - config.entropy_weight * means.pop("bonus"), means


def minibatch_step(
    config: Config,
    network: Network,
    weights: Metrics,
    learner: Learner,
    batch: Batch,
    memory: PyTree,
    advantage_moments: Moments,
    parts: Parts,
) -> tuple[Learner, Metrics]:
    """Makes one gradient step; a step with a number that is not finite is skipped and counted.

    Args:
      config: the hyperparameters.
      network: the policy and value function.
      weights: of the losses that it names, [] each.
      learner: before the step, unbatched.
      batch: [V, T', M, ...] the minibatch.
      memory: [V, M, H] at the rollout's start.
      advantage_moments: of the minibatch's advantages, [] each.
      parts: how the V parts are computed.

    Returns:
      The learner after the step, and metrics, name -> [].
    """

    def gradient(batch: Batch, memory: PyTree) -> tuple[tuple[Array, Metrics], PyTree]:
        def objective(params: PyTree) -> tuple[Array, Metrics]:
            output = unroll(network, params, batch, memory)
            # Losses of the network's own are added here, since only it knows what they are of.
            total, means = loss(config, output, advantage_moments, batch)
            own = (weight * means[f"auxiliary/{name}"] for name, weight in weights.items())
            return sum(own, total), means

        return jax.value_and_grad(objective, has_aux=True)(learner.params)

    # The gradient of a sum is the sum of gradients, so parts meet here and nowhere else in a step.
    (objective, metrics), gradients = parts.sum(gradient, batch, memory)
    # One number that is not finite makes the norm so. The loss may be NaN though no gradient is.
    norm = optax.tree.norm(gradients)
    sound = jnp.isfinite(objective) & jnp.isfinite(norm)
    # Made in any case, and dropped below if it is not sound. On a GPU a branch makes the host wait.
    updates, optimizer_state = optimizer(config).update(gradients, learner.optimizer)
    # The rate is float32; parameters may have half of its precision, and keep their dtype.
    rate = learner.learning_rate
    updates = network.scale(updates)
    stepped = jax.tree.map(lambda x, u: x - (rate * u).astype(x.dtype), learner.params, updates)
    new, old = (stepped, optimizer_state), (learner.params, learner.optimizer)
    params, optimizer_state = jax.tree.map(lambda x, y: jnp.where(sound, x, y), new, old)
    rate = next_rate(config, rate, metrics["kl"], sound)
    # Whoever runs the loop may stop a run that does nothing but skip.
    in_a_row = jnp.where(sound, 0, learner.skipped_in_a_row + 1)
    learner = Learner(params, optimizer_state, rate, in_a_row)
    skipped = 1.0 - sound.astype(jnp.float32)
    return learner, metrics | {"loss": objective, "gradient_norm": norm, "skipped": skipped}
