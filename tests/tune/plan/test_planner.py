"""Planners against hand-worked weights, and on toys of which the best action is known."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from purerl.tune.plan import planner
from purerl.tune.plan.settings import Settings
from tests import quick
from tests.tune.plan.toys import Ending, Point

NAMES = ("predictive_sampling", "mppi", "cem")
RETURNS = jnp.array([1.0, 4.0, 2.0, 3.0])


def shares(name, returns, **settings):
    given = {"samples": len(returns), "elites": 2} | settings
    return np.asarray(planner.sample_weights(Settings(name, **given), jnp.asarray(returns)))


def test_predictive_sampling_takes_the_best():
    assert shares("predictive_sampling", RETURNS).tolist() == [0.0, 1.0, 0.0, 0.0]


def test_mppi_by_hand():
    spread = np.sqrt(1.25)  # of 1, 2, 3, 4
    raw = np.exp(np.array([-3.0, 0.0, -2.0, -1.0]) / (0.5 * spread))
    np.testing.assert_allclose(shares("mppi", RETURNS, temperature=0.5), raw / raw.sum(), rtol=1e-5)


def test_mppi_does_not_know_the_unit_of_the_reward():
    np.testing.assert_allclose(shares("mppi", RETURNS), shares("mppi", RETURNS * 100), rtol=1e-4)


def test_cem_by_hand():
    share = shares("cem", RETURNS)
    assert share.tolist() == [0.0, 0.5, 0.0, 0.5]
    knots = jnp.array([9.0, 0.2, 9.0, 0.6])[:, None, None]
    settings = Settings("cem", samples=4, elites=2)
    mean, scale = planner.summarize(settings, knots, jnp.asarray(share))
    assert (float(mean[0, 0]), float(scale[0, 0])) == pytest.approx((0.4, 0.2))
    _, least = planner.summarize(settings, jnp.full((4, 1, 1), 0.4), jnp.asarray(share))
    assert float(least[0, 0]) == pytest.approx(planner.LEAST_NOISE)


@pytest.mark.parametrize("name", NAMES)
def test_a_lost_sample_has_no_share(name):
    share = shares(name, [-jnp.inf, 1.0, -jnp.inf, -jnp.inf])
    assert share.tolist() == [0.0, 1.0, 0.0, 0.0]
    # If all are lost, the first one: the plan as it was.
    assert shares(name, [-jnp.inf] * 3).tolist() == [1.0, 0.0, 0.0]


@pytest.mark.parametrize("name", NAMES)
def test_where_the_reward_says_nothing_a_random_sample_is_taken(name):
    """The first two are no random ones: the plan as it was, and the guide's own behaviour."""
    assert shares(name, [2.0] * 4).tolist() == [0.0, 0.0, 0.0, 1.0]
    assert shares(name, [2.0, 2.0, -jnp.inf, 2.0])[3] < 1.0


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"samples": 1}, "samples is 1; it must be at least 2."),
        ({"noise": 0.0}, "noise is 0.0; it must be above 0."),
        ({"planner": "cem", "samples": 4, "elites": 5}, "elites is 5; there are only 4 samples."),
    ],
)
def test_settings_out_of_range(settings, message):
    with pytest.raises(ValueError, match=message):
        Settings(**settings)


def test_samples_are_the_plan_the_guide_alone_and_more_and_more_noise():
    settings = Settings(samples=400, noise=0.02)
    mean = jnp.full((50, 4), 0.1)
    knots = planner.draw(settings, mean, jnp.full(mean.shape, 0.02), jax.random.key(0))
    assert bool((knots[0] == mean).all()) and not knots[1].any()
    deviation = np.asarray(knots - mean).std(axis=(1, 2))
    assert deviation[2:12].mean() == pytest.approx(0.02 / 4, rel=0.15)
    assert deviation[-10:].mean() == pytest.approx(0.02 * 4, rel=0.15)
    assert float(jnp.abs(planner.draw(settings, mean, mean * 99, jax.random.key(0))).max()) == 1.0


# --- what plans are worth ---


UNGUIDED = planner.unguided(1)


def value_of(number, discount):
    """A guide that does nothing and values every state alike."""

    def act(env, memory):
        zeros = jnp.zeros(env.reward.shape)
        return zeros[:, None], zeros + number, memory

    return planner.Guide(act, (), discount)


def worth(env, guide, horizon=5):
    settings = Settings(horizon=horizon, samples=2, elites=2, knots=2)
    start = jax.vmap(env.reset)(jax.random.split(jax.random.key(0)))
    return planner.play(settings, env, guide, start, (), jnp.zeros((2, 2, 1)))[0]


@pytest.mark.slow
@pytest.mark.parametrize("after", [1.0, -5.0, np.nan])
def test_what_comes_after_a_termination_counts_zero(after):
    assert worth(Ending("terminated", after), UNGUIDED) == 3.0
    assert worth(Ending("terminated", after), value_of(8.0, 0.5)) == 1.75


@pytest.mark.slow
def test_a_truncation_is_worth_its_value():
    assert worth(Ending("truncated", -5.0), value_of(8.0, 0.5)) == 1.75 + 0.5**3 * 8.0
    assert worth(Ending("truncated", -5.0), value_of(8.0, 0.5), 3) == 1.75 + 0.5**3 * 8.0


@pytest.mark.slow
def test_the_horizon_is_worth_its_value():
    assert worth(Ending("never"), value_of(8.0, 0.5), 2) == 1.5 + 0.5**2 * 8.0


@pytest.mark.slow
def test_a_lost_simulation_is_worth_nothing_at_all():
    assert worth(Ending("lost"), UNGUIDED) == -jnp.inf


# --- what is chosen ---


@functools.cache
def program(settings, env, guide):
    return quick.jit(functools.partial(planner.plan, settings, env, guide))


def choose(settings, env, guide, place, steps=1, seed=0):
    """Plans `steps` times in the same state, as if it did not move on; returns the last action."""
    state = env.reset(jax.random.key(0)).replace(physics=jnp.asarray(place, jnp.float32))
    step = program(settings, env, guide)
    last = planner.start(settings, env, guide)
    for number in range(steps):
        last, action = step(last, state, jax.random.fold_in(jax.random.key(seed), number))
    return last, action


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("place", [0.05, -0.08, 3.0])
def test_the_best_action_of_a_point_is_found(name, place):
    """Of one step, the best action takes x to 0: -x / 0.1, cut at 1."""
    settings = Settings(name, samples=256, horizon=1, knots=2, iterations=6, temperature=0.05)
    plan, action = choose(settings, Point(), UNGUIDED, place, steps=4)
    best = np.clip(-place / 0.1, -1.0, 1.0)
    assert float(action[0]) == pytest.approx(best, abs=0.05)
    assert float(plan.value) == pytest.approx(-((place + 0.1 * best) ** 2), abs=0.02 * abs(place))


@pytest.mark.slow
def test_with_a_perfect_value_one_step_is_enough():
    """The reward says nothing, the value all: -|x - 1|, to be gone to by the fastest way."""

    def act(env, memory):
        place = env.physics
        return jnp.zeros((*place.shape, 1)), -jnp.abs(place - 1.0), memory

    settings = Settings(samples=128, horizon=1, knots=2, iterations=4)
    blind = Point(weight=0.0)
    _, action = choose(settings, blind, planner.Guide(act, (), 1.0), 0.0, steps=3)
    assert float(action[0]) > 0.95
    _, action = choose(settings, blind, UNGUIDED, 0.0, steps=3)
    assert float(action[0]) < 0.95  # nothing is known of where to go


@pytest.mark.slow
def test_a_plan_corrects_its_guide_and_may_leave_it_alone():
    """The second sample is the guide's own behaviour: with the best guide nothing is corrected."""

    def best(env, memory):
        return jnp.clip(-env.physics / 0.1, -1.0, 1.0)[:, None], 0.0 * env.physics, memory

    settings = Settings(samples=32, horizon=4, knots=3)
    plan, action = choose(settings, Point(), planner.Guide(best, (), 0.9), 0.05, steps=3)
    assert float(jnp.abs(plan.knots).max()) == 0.0
    assert float(action[0]) == pytest.approx(-0.5)


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_same_seed_same_bits(name):
    settings = Settings(name, samples=16, horizon=5, knots=3, iterations=2)
    plans = [choose(settings, Point(), UNGUIDED, 0.7, 2, s)[0].knots for s in (1, 1, 2)]
    assert np.array_equal(plans[0], plans[1]) and not np.array_equal(plans[0], plans[2])
