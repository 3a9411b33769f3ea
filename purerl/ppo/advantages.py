"""Generalised advantage estimation (Schulman et al. 2016, arXiv:1506.02438), one trajectory."""

import chex
import jax
import jax.numpy as jnp

from purerl.core.records import Array

SHORT = 16  # steps; so short a loop is written out, since its rounds cost more than they compute


def temporal_difference(
    reward: Array, value: Array, next_value: Array, terminated: Array, gamma: float
) -> Array:
    """Returns delta_t = r_t + gamma * V(s'_t) * (1 - terminated_t) - V(s_t), [T].

    Args:
      reward: [T] scaled reward, of one trajectory, unbatched, as all that follows.
      value: [T] V(s_t).
      next_value: [T] V(s'_t), the value of the observation that the step led to, before any reset.
      terminated: [T] bool: nothing comes after the step.
      gamma: discount.
    """
    # `where`, not a product: the value of what comes after an end may be NaN, as 0 times NaN is.
    return reward + gamma * jnp.where(terminated, 0.0, next_value) - value


def discounted_sum(delta: Array, decay: Array) -> Array:
    """Returns x_t = delta_t + decay_t * x_{t+1} with x_T = 0, [T].

    Args:
      delta: [T] of one trajectory, unbatched.
      decay: [T] how much of the sum after a step counts at that step.
    """
    chex.assert_equal_shape([delta, decay])

    def backward(following: Array, step: tuple[Array, Array]) -> tuple[Array, Array]:
        delta_t, decay_t = step
        total = delta_t + decay_t * following
        return total, total

    _, totals = jax.lax.scan(
        backward, jnp.zeros_like(delta[0]), (delta, decay), reverse=True, unroll=len(delta) <= SHORT
    )
    return totals


def gae(
    reward: Array, value: Array, next_value: Array, terminated: Array, done: Array, valid: Array,
    gamma: float, lambda_: float,
) -> Array:  # fmt: skip
    """Returns A_t = delta_t + gamma * lambda * (1 - done_t) * A_{t+1}, [T].

    Args:
      reward: [T] scaled reward, of one trajectory, unbatched, as all that follows.
      value: [T] V(s_t).
      next_value: [T] V(s'_t), also at a truncation, where s'_t is the state before the reset.
      terminated: [T] bool, nothing comes after.
      done: [T] bool, terminated or truncated: the next row is another episode.
      valid: [T] bool; an invalid step (its physics blew up) has advantage 0 and passes nothing
        back, so that the step before it bootstraps from its own next value.
      gamma: discount.
      lambda_: decay of the trace, the paper's lambda.
    """
    chex.assert_rank(reward, 1)
    chex.assert_equal_shape([reward, value, next_value, terminated, done, valid])
    chex.assert_type([reward, value, next_value, terminated, done, valid], [float] * 3 + [bool] * 3)
    delta = temporal_difference(reward, value, next_value, terminated, gamma)
    delta = jnp.where(valid, delta, 0.0)
    # A truncation is bootstrapped in delta but cut in the trace: the next row is another episode's.
    return discounted_sum(delta, jnp.where(done | ~valid, 0.0, gamma * lambda_))
