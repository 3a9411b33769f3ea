"""Colored noise: its spectrum, its variance, whose it is, and what an action's probability is."""

import dataclasses
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import multivariate_normal

from purerl.core.records import Normal
from purerl.ppo.config import Config
from purerl.ppo.distributions import given, normal_log_prob
from purerl.ppo.noise import action_noise, coloring

CONFIG = Config.plain(num_steps=64 * 8, num_envs=8, rollout_length=64, num_minibatches=1)
PINK = dataclasses.replace(CONFIG, noise_color=1.0)


def noise_of(config, number, update=0):
    """A rollout's white noise [T, B, 3] of environments, and what is known of each step's."""
    state = SimpleNamespace(
        key=jax.random.key(3), update=jnp.int32(update), env_ids=jnp.asarray(number, jnp.int32)
    )
    every = jax.jit(lambda: jax.vmap(action_noise(config, state, 3))(jnp.arange(64)))
    return jax.tree.map(np.asarray, every())


def colored(config, *rest):
    white, known = noise_of(config, *rest)
    return known.loc + known.scale * white


@pytest.mark.parametrize("length", [16, 63, 64, 3000])
@pytest.mark.parametrize("exponent", [0.5, 1.0, 1.5])
def test_the_power_of_a_frequency_is_its_inverse_to_the_exponent(length, exponent):
    factor = coloring(length, exponent)
    covariance = factor @ factor.T
    np.testing.assert_allclose(np.diag(covariance), 1.0)
    assert np.array_equal(factor, np.tril(factor))
    # Wiener and Khinchin: the covariance of two steps is an integral over the spectrum.
    frequency = np.linspace(0.0, 0.5, 400_001)
    power = np.maximum(frequency, 1.0 / length) ** -exponent
    for lag in (1, 2, 5, length - 1):
        waves = np.cos(2.0 * np.pi * frequency * lag)
        expected = np.trapezoid(power * waves, frequency) / np.trapezoid(power, frequency)
        assert covariance[lag, 0] == pytest.approx(expected, abs=2e-3)
        assert covariance[-1, -1 - lag] == pytest.approx(expected, abs=2e-3)


def test_an_exponent_of_0_leaves_noise_white():
    np.testing.assert_allclose(coloring(64, 0.0), np.eye(64), atol=1e-12)
    assert noise_of(CONFIG, range(8))[1] is None
    parameters = Normal(jnp.zeros(3), jnp.ones(3))
    assert given(parameters, None) is parameters


def test_colored_noise_is_standard_normal_in_each_step_and_like_its_neighbours():
    noise = colored(PINK, range(2000))
    np.testing.assert_allclose(noise.std(axis=(1, 2)), 1.0, atol=0.06)
    np.testing.assert_allclose(noise.mean(axis=(1, 2)), 0.0, atol=0.06)
    assert (noise[1:] * noise[:-1]).mean() == pytest.approx(0.63, abs=0.02)
    # Each action and each environment has its own.
    assert abs((noise[:, :-1] * noise[:, 1:]).mean()) < 0.02
    assert abs((noise[..., 0] * noise[..., 1]).mean()) < 0.02


def test_the_noise_before_tells_all_but_the_white_rest():
    white, known = noise_of(PINK, range(2000))
    noise = colored(PINK, range(2000))
    for lag in (1, 2, 10):
        assert abs((white[lag:] * noise[:-lag]).mean()) < 0.02
    assert np.all(known.loc[0] == 0.0) and np.all(known.scale[0] == 1.0)
    assert known.scale[-1] == pytest.approx(0.768, abs=0.001)


def test_probabilities_of_single_actions_make_up_that_of_the_rollout():
    """The product of each given those before is the density of all T steps together."""
    white, known = noise_of(PINK, [4])
    loc = np.linspace(-1.0, 1.0, 64)[:, None, None] * np.ones(3)
    parameters = Normal(jnp.asarray(loc), jnp.full((64, 1, 3), 0.3))
    distribution = given(parameters, known)
    raw = distribution.loc + distribution.scale * white
    factor = coloring(64, 1.0)
    together = multivariate_normal(np.zeros(64), 0.3**2 * factor @ factor.T)
    expected = sum(together.logpdf(np.asarray(raw - loc)[:, 0, a]) for a in range(3))
    assert normal_log_prob(distribution, raw).sum() == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize("config", [CONFIG, PINK])
def test_noise_is_of_an_environments_number_and_of_the_update(config):
    some, others = noise_of(config, [4, 5]), noise_of(config, [5, 6, 7])
    jax.tree.map(lambda x, y: np.testing.assert_allclose(x[:, 1], y[:, 0], atol=1e-6), some, others)
    assert np.abs(some[0] - noise_of(config, [4, 5], 1)[0]).mean() > 0.5


def test_an_exponent_out_of_range_is_refused():
    for wrong in (-0.1, 2.1, float("nan")):
        with pytest.raises(ValueError, match="noise_color is .* must be in \\[0, 2\\]"):
            dataclasses.replace(CONFIG, noise_color=wrong)
