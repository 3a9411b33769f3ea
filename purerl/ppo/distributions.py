"""The policy: a diagonal Gaussian squashed by tanh, action = tanh(raw).

Everything is a function of the *raw* action, the Gaussian sample before squashing. The rollout
stores raw actions. So a log-probability needs no inverse of tanh, and is exact at the edges of the
action range.
"""

import chex
import jax
import jax.numpy as jnp
import numpy as np

from purerl.core.records import Array, Normal

# Gauss-Hermite nodes for the entropy of the squashed Gaussian. 16 nodes give an error below 4e-3
# nats per dimension for every scale up to 2 (tests/ppo/test_distributions.py), and spend no key.
_NODES, _WEIGHTS = np.polynomial.hermite_e.hermegauss(16)
_NODES = _NODES.astype(np.float32)
_WEIGHTS = (_WEIGHTS / _WEIGHTS.sum()).astype(np.float32)


def sample(parameters: Normal, noise: Array) -> Array:
    """Returns the raw action, loc + scale * noise, [..., A].

    Args:
      parameters: [..., A] the Gaussian.
      noise: [..., A] drawn from a standard normal.
    """
    chex.assert_equal_shape([*parameters, noise])
    return parameters.loc + parameters.scale * noise


def given(parameters: Normal, noise: Normal | None) -> Normal:
    """Returns the Gaussian of the raw action if its noise is not standard normal, [..., A].

    Args:
      parameters: [..., A] the policy's Gaussian.
      noise: [..., A] the Gaussian that the noise is drawn from; None: the standard normal.
    """
    if noise is None:
        return parameters
    chex.assert_equal_shape([*parameters, *noise])
    return Normal(parameters.loc + parameters.scale * noise.loc, parameters.scale * noise.scale)


def to_action(raw: Array) -> Array:
    """Returns the action tanh(raw), in [-1, 1], same shape."""
    return jnp.tanh(raw)


def log_prob(parameters: Normal, raw: Array) -> Array:
    """Returns the log-density of action = tanh(raw), [...], by a change of variables.

    Args:
      parameters: [..., A] the Gaussian of the raw action.
      raw: [..., A] the raw action.
    """
    return normal_log_prob(parameters, raw) - log_tanh_derivative(raw).sum(axis=-1)


def entropy(parameters: Normal) -> Array:
    """Returns H[tanh(X)] = H[X] + E[log tanh'(X)], [...] nats, by Gauss-Hermite quadrature."""
    chex.assert_equal_shape([*parameters])
    # E[f(X)] = sum_i w_i f(loc + scale * x_i). The nodes are constants, so a gradient passes, and
    # two evaluations of one policy agree to the bit.
    loc, scale = parameters.loc[..., None], parameters.scale[..., None]
    raw = loc + scale * _NODES.reshape((1,) * parameters.loc.ndim + (-1,))
    correction = log_tanh_derivative(raw) @ _WEIGHTS
    return normal_entropy(parameters) + correction.sum(axis=-1)


def normal_log_prob(parameters: Normal, raw: Array) -> Array:
    """Returns log N(raw; loc, scale^2) summed over action features, [...].

    Args:
      parameters: [..., A] loc and scale.
      raw: [..., A] where the density is wanted.
    """
    chex.assert_equal_shape([*parameters, raw])
    chex.assert_type([*parameters, raw], float)
    # A product over independent features is a sum of logarithms; [..., A] becomes [...].
    standardized = (raw - parameters.loc) / parameters.scale
    per_feature = -0.5 * (jnp.square(standardized) + np.log(2 * np.pi)) - jnp.log(parameters.scale)
    return per_feature.sum(axis=-1)


def normal_entropy(parameters: Normal) -> Array:
    """Returns the differential entropy sum_a (1/2 + 1/2 log 2 pi + log scale_a), [...] nats."""
    return (0.5 + 0.5 * np.log(2 * np.pi) + jnp.log(parameters.scale)).sum(axis=-1)


def log_tanh_derivative(raw: Array) -> Array:
    """Returns log(1 - tanh(raw)^2), elementwise, without overflow or cancellation.

    1 - tanh(x)^2 = 4 / (e^x + e^-x)^2, hence 2 (log 2 - x - log(1 + e^-2x)).
    """
    return 2.0 * (np.log(2.0) - raw - jax.nn.softplus(-2.0 * raw))
