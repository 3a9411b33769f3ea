"""Adam, and a learning rate that is constant, linear or steered by the policy's KL."""

import jax.numpy as jnp
import optax

from purerl.core.records import Array, TrainState
from purerl.ppo.config import Config


def optimizer(config: Config) -> optax.GradientTransformation:
    """Clips by global norm, then Adam's direction; the caller multiplies by the learning rate."""
    return optax.chain(
        optax.clip_by_global_norm(config.max_gradient_norm), optax.scale_by_adam(eps=1e-5)
    )


def scheduled_rate(config: Config, state: TrainState) -> Array:
    """Returns the learning rate that this update starts with, []; a resumed run may set another."""
    if config.schedule == "adaptive_kl":
        return state.learning_rate
    left = 1.0 - state.update.astype(jnp.float32) / config.num_updates
    return jnp.float32(config.learning_rate) * (left if config.schedule == "linear" else 1.0)


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
