"""Log-probabilities and entropies against numerical integration."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import integrate, stats

from purerl.core.records import Normal
from purerl.ppo import distributions


@pytest.fixture(autouse=True)
def strict():
    with jax.numpy_rank_promotion("raise"), jax.numpy_dtype_promotion("strict"):
        yield


def normal(loc, scale):
    return Normal(jnp.asarray([loc], jnp.float32), jnp.asarray([scale], jnp.float32))


def test_normal_against_scipy():
    raw = np.linspace(-3, 3, 7)
    for x in raw:
        ours = distributions.normal_log_prob(normal(0.3, 0.7), jnp.asarray([x], jnp.float32))
        np.testing.assert_allclose(ours, stats.norm(0.3, 0.7).logpdf(x), rtol=1e-5)
    entropy = distributions.normal_entropy(normal(0.3, 0.7))
    np.testing.assert_allclose(entropy, stats.norm(0.3, 0.7).entropy(), rtol=1e-6)


@pytest.mark.parametrize("loc", [0.0, 1.0])
@pytest.mark.parametrize("scale", [0.1, 0.5, 1.0])
def test_tanh_normal_density_integrates_to_one(loc, scale):
    grid = np.tanh(np.linspace(-8, 8, 4001))
    raw = jnp.asarray(np.arctanh(grid), jnp.float32)[:, None]
    parameters = Normal(jnp.full((4001, 1), loc), jnp.full((4001, 1), scale))
    density = np.exp(distributions.log_prob(parameters, raw))
    mass = integrate.trapezoid(density, grid)
    np.testing.assert_allclose(mass, 1.0, atol=2e-3)


def test_tanh_normal_is_exact_at_the_edge_of_the_range():
    """At raw = 30, tanh is 1 to the last bit; density and gradient stay finite and exact."""
    raw = jnp.asarray([30.0], jnp.float32)

    def log_prob(loc):
        return distributions.log_prob(Normal(loc, jnp.ones(1)), raw)

    loc = jnp.asarray([29.0], jnp.float32)
    # log N(30; 29, 1) - log(1 - tanh(30)^2), the latter = log 4 - 60 to within 1e-26.
    expected = stats.norm(29, 1).logpdf(30) - (np.log(4.0) - 60.0)
    np.testing.assert_allclose(log_prob(loc), expected, rtol=1e-6)
    np.testing.assert_allclose(jax.grad(log_prob)(loc), [1.0], rtol=1e-6)


@pytest.mark.parametrize("loc", [0.0, 0.5, 2.0])
@pytest.mark.parametrize("scale", [0.05, 0.5, 1.0, 2.0])
def test_tanh_normal_entropy_against_quadrature(loc, scale):
    def integrand(x):
        log_derivative = 2 * (np.log(2) - x - np.logaddexp(0, -2 * x))
        return stats.norm(loc, scale).pdf(x) * log_derivative

    correction, _ = integrate.quad(integrand, loc - 12 * scale, loc + 12 * scale, limit=200)
    expected = stats.norm(loc, scale).entropy() + correction
    ours = distributions.entropy(normal(loc, scale))
    np.testing.assert_allclose(ours, expected, atol=4e-3)


def test_features_add_up():
    parameters = Normal(jnp.asarray([0.1, -0.4]), jnp.asarray([0.5, 2.0]))
    raw = jnp.asarray([0.3, 1.0])
    singles = [jax.tree.map(lambda x, i=i: x[i : i + 1], (parameters, raw)) for i in range(2)]
    parts = [distributions.log_prob(*single) for single in singles]
    np.testing.assert_allclose(distributions.log_prob(parameters, raw), sum(parts), rtol=1e-6)


def test_actions_stay_in_range():
    raw = jnp.asarray([-50.0, -0.5, 0.0, 50.0])
    np.testing.assert_allclose(distributions.to_action(raw), np.tanh(raw), rtol=1e-6)
