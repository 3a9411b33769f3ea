"""The noise of actions: white, or colored, which pushes one way for several steps.

A body averages white noise out: before a joint has moved, the push has changed its sign. Colored
noise has more power at low frequencies (Hollenstein, Martius and Piater 2024, arXiv:2312.11091, who
take each action's probability as if its noise stood alone). Here the probability is that given the
noise before, so the policy's gradient stays exact.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from purerl.core.keys import Purpose, derive, per_environment
from purerl.core.records import Array, Normal, TrainState
from purerl.ppo.config import Config


def action_noise(
    config: Config, state: TrainState, size: int
) -> Callable[[Array], tuple[Array, Normal | None]]:
    """Returns a function from the step t [] of a rollout to its noise, for all environments.

    The function returns white noise [B, A], and the Gaussian [B, A] that the noise of the step
    has, given the noise of the steps before it in the rollout: the noise is loc + scale * white.
    None instead of the Gaussian: the noise is the white noise itself.

    Args:
      config: for the color and T.
      state: for the run's key, the update and the environments' ids [B].
      size: A, features of an action.
    """
    key, length = derive(state.key, Purpose.ACTION, state.update), config.rollout_length

    # Folded with the step and then with the environment's id, so a rollout's noise does not depend
    # on which environments are computed together.
    def draw(t: Array) -> Array:
        return white(jax.random.fold_in(key, t), state.env_ids, size)

    if not config.noise_color:
        return lambda t: (draw(t), None)
    # Row t of the triangular factor L says what the noise of step t is: L[t, :t] @ drawn[:t] is
    # known before the step (the mean), L[t, t] * drawn[t] is new (the deviation).
    factor = coloring(length, config.noise_color)  # float64: finer than what processors differ by
    before, rest = (jnp.asarray(x, jnp.float32) for x in (np.tril(factor, -1), np.diag(factor)))
    drawn = jax.vmap(draw)(jnp.arange(length))
    loc = jnp.einsum("st,tba->sba", before, drawn)  # s: the step, t: each of those before it
    noise = drawn, Normal(loc, jnp.broadcast_to(rest[:, None, None], loc.shape))
    return lambda t: jax.tree.map(lambda x: x[t], noise)


def white(key: Array, env_ids: Array, size: int) -> Array:
    """Returns standard normal noise [B, A].

    Args:
      key: [] typed, of one control step.
      env_ids: [B] int32.
      size: A, features of an action.
    """
    return jax.vmap(lambda key: jax.random.normal(key, (size,)))(per_environment(key, env_ids))


def coloring(length: int, exponent: float) -> np.ndarray:
    """Returns the lower triangular matrix [T, T] that colors white noise of T = `length` steps.

    The power at frequency f is 1 / f^exponent, down to a period of T steps and constant below. A
    step's variance is 1. The diagonal is the part of each step that those before do not tell.

    Args:
      length: T [control steps].
      exponent: b of the power 1 / f^b.
    """
    # The noise is stationary, so its covariance is a Toeplitz matrix, and its first row is the
    # Fourier transform of the power (Wiener and Khinchin). Cholesky's factor is the causal root:
    # step t is made of the white noise up to t, and of none to come.
    frequency = np.maximum(np.fft.rfftfreq(max(2**16, 16 * length)), 1.0 / length)
    covariance = np.fft.irfft(frequency**-exponent)[:length]
    steps = np.arange(length)
    return np.linalg.cholesky((covariance / covariance[0])[abs(steps[:, None] - steps)])
