"""Adam, and a learning rate that is constant, linear or steered by the policy's KL.

Optax usually multiplies by the learning rate itself, as the last link of its chain. Here the
learner does. The rate is a number of `TrainState`: the policy's KL moves it after each minibatch,
and a resumed run may set another. Inside optax it would be part of the optimizer's state, and a
change of schedule would change what a checkpoint holds.
"""

import jax.numpy as jnp
import optax

from purerl.core.records import Array, Metrics, TrainState, count_as_float
from purerl.ppo.config import Config


def optimizer(config: Config) -> optax.GradientTransformation:
    """Clips by global norm, then Adam's direction; the caller multiplies by minus the rate."""
    # Adam divides by the gradient's own size plus eps. With optax's eps of 1e-8, a gradient that is
    # mere rounding would make a whole step; OpenAI's PPO has 1e-5, too.
    return optax.chain(
        optax.clip_by_global_norm(config.max_gradient_norm), optax.scale_by_adam(eps=1e-5)
    )


def scheduled_rate(config: Config, state: TrainState) -> Array:
    """Returns the learning rate that an update starts with, [].

    Args:
      config: the schedule. A resumed run may set another rate, and it counts at once.
      state: for the update's number, and for the rate that the adaptive schedule left.
    """
    if config.schedule == "adaptive_kl":
        return state.learning_rate
    # 1 at the first update and 1 / num_updates at the last: no update is made with a rate of 0.
    left = 1.0 - state.update.astype(jnp.float32) / config.num_updates
    return jnp.float32(config.learning_rate) * (left if config.schedule == "linear" else 1.0)


def auxiliary_weights(config: Config, state: TrainState) -> Metrics:
    """Returns the weights of the network's own losses in an update, name -> [].

    Args:
      config: the weights, and how they rise or fall.
      state: for the control steps of the whole run so far, so that a resumed run has the same.
    """

    # Of steps, not of updates: another size of rollout leaves the ramp where it is.
    def now(first: float, last: float, steps: int = 1) -> Array:
        share = count_as_float(state.steps) / max(steps, 1)
        return first + (last - first) * jnp.minimum(share, 1.0)

    ramps = {k: (w, w) if isinstance(w, float | int) else w for k, w in config.auxiliary.items()}
    return {name: now(*ramp) for name, ramp in ramps.items()}


def next_rate(config: Config, rate: Array, kl: Array, sound: Array) -> Array:
    """Returns the learning rate after a minibatch whose policy had moved by `kl` [].

    The adaptive schedule of Schulman et al. 2017 (section 4), applied to the learning rate: a
    factor 1.5 down above twice the desired KL, up below half of it, within [1e-5, 1e-2]. A first
    rate outside moves towards it alone.

    Args:
      config: the schedule.
      rate: [] of the minibatch step before.
      kl: [] estimated KL(old, new) in the minibatch.
      sound: [] bool: the step was made. The KL of a skipped one may be NaN, and moves nothing.
    """
    if config.schedule != "adaptive_kl":
        return rate
    down = jnp.minimum(rate, jnp.maximum(rate / 1.5, 1e-5))
    up = jnp.maximum(rate, jnp.minimum(rate * 1.5, 1e-2))
    moved = jnp.where(kl < 0.5 * config.desired_kl, up, rate)
    moved = jnp.where(kl > 2.0 * config.desired_kl, down, moved)
    return jnp.where(sound, moved, rate)
