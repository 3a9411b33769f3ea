"""The noise of actions: white, or colored, which pushes one way for several steps.

A body averages white noise out: before a joint has moved, the push has changed its sign. Colored
noise has more of its power at low frequencies (Hollenstein, Martius and Piater 2024, "Colored Noise
in PPO", arXiv:2312.11091). There each action's probability is taken as if its noise stood alone.
Here it is the one given the noise before, so that the policy's gradient stays exact.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from purerl.core.keys import Purpose, derive, per_environment
from purerl.core.records import Array, Normal, TrainState
from purerl.ppo.config import Config

FREQUENCIES = 2**16  # frequencies of which a covariance is summed, at least


class Prediction(NamedTuple):
    """What a step's noise is expected to be, given the noise before it in the rollout: Gaussian."""

    mean: Array  # [..., A]
    std: Array  # [...], at most 1


def action_noise(
    config: Config, state: TrainState, size: int
) -> Callable[[Array], tuple[Array, Prediction | None]]:
    """Returns the function t [] -> white noise [B, A] of a rollout's step, and its prediction.

    The prediction is None where noise is white. A = `size` actions.
    """
    key = derive(state.key, Purpose.ACTION, state.update)

    def white(t: Array) -> Array:
        keys = per_environment(jax.random.fold_in(key, t), state.number)
        return jax.vmap(lambda key: jax.random.normal(key, (size,)))(keys)

    if not config.noise_color:
        return lambda t: (white(t), None)
    # In float64: what processors differ by is far below a float32.
    factor = coloring(config.rollout_length, config.noise_color)
    drawn = jax.vmap(white)(jnp.arange(config.rollout_length))
    means = jnp.einsum("st,tba->sba", jnp.asarray(np.tril(factor, -1), jnp.float32), drawn)
    stds = jnp.asarray(np.diag(factor), jnp.float32)

    def colored(t: Array) -> tuple[Array, Prediction]:
        return drawn[t], Prediction(means[t], jnp.broadcast_to(stds[t], state.number.shape))

    return colored


def coloring(length: int, exponent: float) -> np.ndarray:
    """Returns the lower triangular matrix [T, T] that colors white noise of T = `length` steps.

    The power at frequency f is 1 / f^exponent, down to a period of T steps and constant below. A
    step's variance is 1. The diagonal is the part of each step that those before do not tell.
    """
    frequency = np.maximum(np.fft.rfftfreq(max(FREQUENCIES, 16 * length)), 1.0 / length)
    covariance = np.fft.irfft(frequency**-exponent)[:length]
    steps = np.arange(length)
    return np.linalg.cholesky((covariance / covariance[0])[abs(steps[:, None] - steps)])


def given(parameters: Normal, prediction: Prediction | None) -> Normal:
    """Returns the Gaussian of a raw action [..., A] whose noise is predicted."""
    if prediction is None:
        return parameters
    scale = parameters.scale
    return Normal(parameters.loc + scale * prediction.mean, scale * prediction.std[..., None])
