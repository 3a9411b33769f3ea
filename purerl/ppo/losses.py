"""The PPO objective (Schulman et al. 2017, arXiv:1707.06347), as functions of plain arrays.

Nothing here takes a mean: the learner adds up over the samples that count, because it may hold
only a part of a minibatch.
"""

import math

import chex
import jax.numpy as jnp

from purerl.core.parts import Parts
from purerl.core.records import Array
from purerl.ppo.running_moments import Moments, moments_of, pool


def normalize_advantage(advantage: Array, moments: Moments, least: float, clip: float) -> Array:
    """Returns (A - mean) / max(std, least), then clipped to +- clip, elementwise.

    Args:
      advantage: [...] of samples of one minibatch.
      moments: of that whole minibatch, [] each, unbatched.
      least: the least deviation to divide by [scaled reward]; 0: any, however small.
      clip: range of what is returned, in standard deviations; 0: any.
    """
    chex.assert_type(advantage, float)
    chex.assert_rank([moments.mean, moments.variance], 0)
    # With `least` 0, equal advantages must still not divide by zero.
    std = jnp.sqrt(moments.variance) + 1e-8
    normalized = (advantage - moments.mean) / (jnp.maximum(std, least) if least else std)
    # One failure among M samples that are alike is sqrt(M) deviations away, and the clip of the
    # ratio does not hold a negative advantage: see `clipped_surrogate`.
    return jnp.clip(normalized, -clip, clip) if clip else normalized


def clipped_surrogate(log_ratio: Array, advantage: Array, clip: float) -> Array:
    """Returns -min(r A, clip(r, 1 - c, 1 + c) A), elementwise, r = exp(log_ratio) (equation 7).

    Args:
      log_ratio: [...] log of new over old probability of the action.
      advantage: [...] normalized.
      clip: c, the paper's epsilon.
    """
    chex.assert_equal_shape([log_ratio, advantage])
    chex.assert_type([log_ratio, advantage], float)
    ratio = jnp.exp(log_ratio)
    clipped = jnp.clip(ratio, 1.0 - clip, 1.0 + clip)
    # The minimum is pessimistic: a gain beyond the clip earns nothing, a loss beyond it counts in
    # full. So the gradient vanishes only where the step has already gone far in its own direction.
    return -jnp.minimum(ratio * advantage, clipped * advantage)


def value_loss(value: Array, target: Array) -> Array:
    """Returns (V - G)^2 / 2, elementwise.

    Args:
      value: [...] V(s_t), of the network that learns.
      target: [...] G_t, the advantage plus the old value, which the gradient does not reach.
    """
    chex.assert_equal_shape([value, target])
    chex.assert_type([value, target], float)
    return 0.5 * jnp.square(value - target)


def bounded_entropy(entropy: Array, action_size: int, target: float) -> Array:
    """Returns the mean entropy of an action [nats], at most `target`, elementwise.

    Args:
      entropy: [...] nats, of all A actions together.
      action_size: A.
      target: the entropy of an action beyond which more earns nothing [nats].
    """
    mean = entropy / action_size  # a sum would outweigh what one action of many can earn
    # No squashed Gaussian has more than log 2, which is a uniform action's: the bound is idle.
    return mean if target >= math.log(2.0) else jnp.minimum(mean, target)


def approximate_kl(log_ratio: Array) -> Array:
    """Returns (r - 1) - log r, elementwise: an unbiased, never negative estimate of KL(old, new).

    Schulman, "Approximating KL divergence" (2020), the estimator k3; `log_ratio` [...] is log r.
    """
    return jnp.expm1(log_ratio) - log_ratio


def explained_variance(value: Array, target: Array, valid: Array, parts: Parts) -> Array:
    """Returns 1 - Var(target - value) / Var(target), []; 1 is perfect, 0 no better than a constant.

    Args:
      value: [V, ...] of V parts.
      target: [V, ...] what the value should have been.
      valid: [V, ...] bool: which samples count.
      parts: how the V parts are computed.
    """
    chex.assert_equal_shape([value, target, valid])
    chex.assert_type([value, target, valid], [float, float, bool])

    def both(value: Array, target: Array, valid: Array) -> Moments:
        return moments_of({"error": target - value, "target": target}, valid)

    variance = pool(parts.gather(parts.map(both, value, target, valid))).variance
    return 1.0 - variance["error"] / jnp.maximum(variance["target"], 1e-8)
