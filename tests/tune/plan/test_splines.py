"""Splines against numpy, scipy and hand-worked values."""

import numpy as np
import pytest
from scipy.interpolate import CubicHermiteSpline

from purerl.tune.plan import splines
from purerl.tune.plan.planner import shift, spline
from purerl.tune.plan.settings import Settings

KNOTS = np.array([0.0, 2.0, 4.0, 6.0])
VALUES = np.array([1.0, -1.0, 0.5, 0.0])
TIMES = np.array([0.0, 0.5, 2.0, 3.9, 5.0, 6.0])


def test_zero_order_holds_the_last_knot():
    values = splines.weights("zero", TIMES, KNOTS) @ VALUES
    assert values.tolist() == [1.0, 1.0, -1.0, -1.0, 0.5, 0.0]


def test_linear_is_numpys():
    values = splines.weights("linear", TIMES, KNOTS) @ VALUES
    np.testing.assert_allclose(values, np.interp(TIMES, KNOTS, VALUES), atol=1e-6)


def test_cubic_is_scipys_with_slopes_by_finite_differences():
    slopes = [-1.0, (-1.0 + 0.75) / 2, (0.75 - 0.25) / 2, -0.25]
    expected = CubicHermiteSpline(KNOTS, VALUES, slopes)(TIMES)
    np.testing.assert_allclose(splines.weights("cubic", TIMES, KNOTS) @ VALUES, expected, atol=1e-6)


@pytest.mark.parametrize("kind", splines.KINDS)
def test_beyond_its_ends_a_spline_keeps_its_value(kind):
    values = splines.weights(kind, np.array([-1.0, 9.0]), KNOTS) @ VALUES
    np.testing.assert_allclose(values, [1.0, 0.0], atol=1e-6)


def test_where_knots_stand():
    assert splines.knot_times("linear", 9, 3).tolist() == [0.0, 4.0, 8.0]
    assert splines.knot_times("zero", 9, 3).tolist() == [0.0, 3.0, 6.0]


@pytest.mark.parametrize("kind", splines.KINDS)
def test_a_warm_start_is_the_same_plan_a_step_later(kind):
    """With a knot for each step nothing is lost."""
    settings = Settings(horizon=5, knots=5, spline=kind)
    knots = np.arange(10.0, dtype=np.float32).reshape(5, 2) ** 2
    before, after = (spline(settings, k[None])[:, 0] for k in (knots, shift(settings, knots)))
    np.testing.assert_allclose(after[:-1], before[1:], rtol=1e-6)
    np.testing.assert_allclose(after[-1], before[-1], rtol=1e-6)  # the last action is repeated


def test_a_warm_start_of_few_knots_is_the_spline_at_their_places_a_step_later():
    settings = Settings(horizon=9, knots=3, spline="linear")  # at 0, 4, 8
    knots = np.array([[0.0], [4.0], [0.0]], np.float32)
    assert shift(settings, knots)[:, 0].tolist() == [1.0, 3.0, 0.0]
