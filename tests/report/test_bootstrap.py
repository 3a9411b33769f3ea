"""Statistics over seeds: hand-worked values, scipy, and how often an interval holds the truth."""

import itertools

import numpy as np
import pytest
from scipy import stats

from purerl.report import bootstrap
from purerl.report.bootstrap import Interval


@pytest.mark.parametrize(
    "values, expected",
    [
        ([3.0], 3.0),
        ([1.0, 5.0, 3.0], 3.0),  # nothing is cut
        ([100.0, 2.0, 4.0, -100.0], 3.0),  # one on each side
        ([9.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0], 4.0),  # 2 .. 6
        ([0.0, 0.0, 1.0, 2.0, 3.0, 4.0, 50.0, 60.0], 2.5),  # two on each side
    ],
)
def test_iqm_by_hand(values, expected):
    assert bootstrap.interquartile_mean(np.array(values)) == expected


@pytest.mark.parametrize("n", range(1, 14))
def test_iqm_is_scipys_trimmed_mean(n):
    values = np.random.default_rng(n).normal(size=(3, n))
    expected = stats.trim_mean(values, 0.25, axis=1)
    np.testing.assert_allclose(bootstrap.interquartile_mean(values), expected, rtol=1e-12)


def test_iqm_of_nothing_is_refused():
    with pytest.raises(ValueError, match="no values"):
        bootstrap.interquartile_mean(np.zeros(0))


def test_probability_of_improvement_by_hand():
    x, y = np.array([1.0, 3.0]), np.array([0.0, 1.0, 5.0])
    # 1 beats 0, ties 1; 3 beats 0 and 1: 3.5 of 6.
    assert bootstrap.probability_of_improvement(x, y) == pytest.approx(3.5 / 6)
    assert bootstrap.probability_of_improvement(y, x) == pytest.approx(2.5 / 6)
    assert bootstrap.probability_of_improvement(x, x) == 0.5


def test_probability_of_improvement_is_mann_whitneys_u():
    generator = np.random.default_rng(0)
    x, y = generator.integers(0, 6, 9), generator.integers(1, 7, 7)
    u = stats.mannwhitneyu(x, y).statistic
    assert bootstrap.probability_of_improvement(x, y) == pytest.approx(u / 63)


def test_resamples_stay_within_their_stratum():
    strata = [np.array([1.0, 2.0, 3.0]), np.array([10.0, 20.0])]
    first, second = bootstrap.resample(strata, 0, 400)
    assert first.shape == (400, 3) and second.shape == (400, 2)
    assert set(first.ravel()) == {1.0, 2.0, 3.0} and set(second.ravel()) == {10.0, 20.0}
    assert len({tuple(sorted(row)) for row in first}) == 10  # every multiset of 3 out of 3
    again = bootstrap.resample(strata, 0, 400)
    assert (again[0] == first).all() and (again[1] == second).all()
    assert (bootstrap.resample(strata, 1, 400)[0] != first).any()


def test_interval_against_a_slow_bootstrap():
    values = np.random.default_rng(3).normal(10.0, 2.0, 8)
    generator = np.random.default_rng(99)
    means = [stats.trim_mean(generator.choice(values, 8), 0.25) for _ in range(20_000)]
    found = bootstrap.iqm_interval([values])
    np.testing.assert_allclose(found, np.percentile(means, [2.5, 97.5]), atol=0.12)


@pytest.mark.parametrize("n", [5, 6])
def test_of_few_runs_every_resample_is_taken(n):
    values = np.random.default_rng(n).normal(500.0, 200.0, n)
    every = values[np.array([*itertools.product(range(n), repeat=n)])]
    expected = np.percentile(bootstrap.interquartile_mean(every), [2.5, 97.5])
    np.testing.assert_allclose(bootstrap.iqm_interval([values]), expected, rtol=1e-12)
    np.testing.assert_allclose(
        bootstrap.mean_interval(values), np.percentile(every.mean(1), [2.5, 97.5]), rtol=1e-12
    )


def test_of_two_groups_every_pair_of_resamples_is_taken():
    x, y = np.random.default_rng(0).normal(size=(2, 5))
    rows = np.array([*itertools.product(range(5), repeat=5)])
    each = [bootstrap.interquartile_mean(values[rows]) for values in (x, y)]
    expected = np.percentile(np.subtract.outer(*each), [2.5, 97.5])
    np.testing.assert_allclose(bootstrap.difference_interval([x], [y]), expected, rtol=1e-12)


def test_an_interval_holds_the_truth_about_as_often_as_measured():
    generator = np.random.default_rng(7)
    draws = generator.normal(size=(200, 10))
    found = [bootstrap.iqm_interval([x]) for x in draws]
    held = np.mean([low <= 0.0 <= high for low, high in found])
    assert 0.86 <= held <= 0.98  # nominal 95%, 93% measured elsewhere


def test_no_interval_below_five_runs():
    few, many = [np.arange(4.0)], [np.arange(5.0)]
    assert bootstrap.iqm_interval(few) is None
    assert isinstance(bootstrap.iqm_interval(many), Interval)
    assert bootstrap.iqm_interval([*many, *few]) is None
    for function in (bootstrap.difference_interval, bootstrap.improvement_interval):
        assert function(few, many) is None and function(many, few) is None
        assert function(many, many) is not None


def test_difference_and_improvement_point_the_right_way():
    low, high = [np.arange(6.0)], [np.arange(6.0) + 10.0]
    assert bootstrap.difference_interval(high, low).low > 5.0
    assert bootstrap.difference_interval(low, high).high < -5.0
    assert bootstrap.improvement_interval(high, low) == (1.0, 1.0)
    same = bootstrap.improvement_interval(low, low)
    assert same.low < 0.5 < same.high


def test_strata_are_pooled_for_the_iqm_and_averaged_for_improvement():
    xs, ys = [np.array([1.0, 2.0]), np.array([30.0, 40.0])], [np.array([0.0]), np.array([50.0])]
    assert bootstrap.pooled_iqm(xs) == 16.0  # 1 and 40 are cut
    assert bootstrap.stratified_probability(xs, ys) == 0.5  # 1 and 0


def test_a_band_is_the_interval_at_every_point():
    curves = np.random.default_rng(1).normal(size=(6, 3)) + np.array([0.0, 10.0, 20.0])
    band = bootstrap.curve_band([curves], number=5000)
    for p in range(3):
        assert band.iqm[p] == pytest.approx(stats.trim_mean(curves[:, p], 0.25))
        np.testing.assert_allclose(
            (band.low[p], band.high[p]), bootstrap.iqm_interval([curves[:, p]]), atol=0.1
        )
    few = bootstrap.curve_band([curves[:4]])
    assert few.low is None and few.high is None and few.iqm.shape == (3,)
