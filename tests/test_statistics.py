"""Intervals against SciPy's bootstrap, means against numbers derived by hand."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from hipg_bench.evaluation.statistics import iqm_ci95, mean_ci95

EPISODES = np.random.default_rng(0).gamma(2.0, 3.0, 200)


def test_mean_interval_matches_scipy():
    mean, interval = mean_ci95([EPISODES])
    expected = stats.bootstrap((EPISODES,), np.mean, method="percentile", n_resamples=20_000, rng=1)
    assert mean == pytest.approx(EPISODES.mean())
    # Monte Carlo error of a 2.5 % quantile over 10,000 draws: about 0.02 standard errors, here 0.3 / 50
    width = expected.confidence_interval.high - expected.confidence_interval.low
    assert np.abs(np.array(interval) - expected.confidence_interval).max() < 0.04 * width


def test_iqm_interval_matches_scipy_when_each_run_is_one_number():
    runs = EPISODES[:24]
    iqm, interval = iqm_ci95([[run[None] for run in runs]])
    expected = stats.bootstrap(
        (runs,),
        lambda x, axis: stats.trim_mean(x, 0.25, axis=axis),
        method="percentile",
        n_resamples=20_000,
        rng=1,
    ).confidence_interval
    assert iqm == pytest.approx(stats.trim_mean(runs, 0.25))
    assert np.abs(np.array(interval) - expected).max() < 0.04 * (expected.high - expected.low)


def test_iqm_is_the_mean_of_the_middle_half():
    # means 0, 1, 2, 100: a quarter off each end leaves 1 and 2
    tasks = [[np.array([value, value])] for value in (100.0, 0.0, 2.0, 1.0)]
    iqm, interval = iqm_ci95(tasks)
    # every episode of a task is the same, so there is nothing to be uncertain about
    assert (iqm, interval) == (1.5, (1.5, 1.5))


def test_runs_are_the_unit_of_replication():
    # 30 runs whose means differ with standard deviation s; 1000 episodes each that do not differ at all:
    # the interval of the mean is +-1.96 s / sqrt(30), however many episodes there are
    means = np.random.default_rng(1).normal(size=30)
    mean, (low, high) = mean_ci95([np.full(1000, m) for m in means])
    assert mean == pytest.approx(means.mean())
    assert high - low == pytest.approx(2 * 1.96 * means.std() / np.sqrt(30), rel=0.1)


def test_same_seed_same_interval():
    assert mean_ci95([EPISODES]) == mean_ci95([EPISODES])
    assert mean_ci95([EPISODES]) != mean_ci95([EPISODES], seed=2)


@settings(max_examples=40, deadline=None)
@given(
    st.lists(st.lists(st.floats(-1e3, 1e3), min_size=1, max_size=6), min_size=1, max_size=4),
    st.floats(-10, 10),
    st.floats(0.1, 10),
)
def test_intervals_move_with_the_scale(runs, shift, factor):
    """A score is a linear map of a return, so its interval is the mapped interval."""
    arrays = [np.array(run) for run in runs]
    mean, (low, high) = mean_ci95(arrays, reps=100)
    moved = mean_ci95([shift + factor * run for run in arrays], reps=100)
    flat = (mean, low, high)
    assert np.allclose((moved[0], *moved[1]), [shift + factor * x for x in flat], atol=1e-6)
    assert min(map(min, runs)) - 1e-9 <= low <= high <= max(map(max, runs)) + 1e-9
