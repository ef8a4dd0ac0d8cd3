"""Intervals against SciPy's bootstrap and rliable, means against numbers derived by hand."""

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from hipg_bench import task_spec
from hipg_bench.errors import HipgError
from hipg_bench.evaluation import ranking, statistics
from hipg_bench.evaluation.results import aggregate
from hipg_bench.evaluation.statistics import iqm_ci95, mean_ci95
from hipg_bench.spec import Anchor, Anchors

UNCUT = (-np.inf, np.inf)
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
    iqm, interval = iqm_ci95([[run[None] for run in runs]], clip=UNCUT)
    expected = stats.bootstrap(
        (runs,),
        lambda x, axis: stats.trim_mean(x, 0.25, axis=axis),
        method="percentile",
        n_resamples=20_000,
        rng=1,
    ).confidence_interval
    assert iqm == pytest.approx(stats.trim_mean(runs, 0.25))
    assert np.abs(np.array(interval) - expected).max() < 0.04 * (expected.high - expected.low)


def test_many_runs_of_one_task_do_not_outweigh_the_others():
    """Seven tasks, one of them played 25 times at 0.85: six sevenths of the weight are zeros."""
    tasks = [np.full(25, 0.85), *(np.zeros(1) for _ in range(6))]
    # a quarter, 43 of 175, is cut above, and the 25 lie in it
    assert statistics.iqm(tasks) == 0.0
    # profile: 0.85 is above 0.5 in one task of seven
    np.testing.assert_allclose(statistics.profile(tasks, np.array([-0.1, 0.5])), [1.0, 1 / 7])


def test_iqm_of_unequal_runs_is_that_of_repeated_ones():
    """Two runs of one task and three of another weigh as three copies of the two, and two of the three."""
    two, three = np.array([0.1, 0.7]), np.array([0.2, 0.3, 0.9])
    repeated = np.sort(np.concatenate([np.repeat(two, 3), np.repeat(three, 2)]))
    # with three runs at most, 6 // 4 = 1 of 6 equal parts is cut at each end: two of the twelve copies
    assert statistics.iqm([two, three]) == pytest.approx(repeated[2:-2].mean())


def test_iqm_is_the_mean_of_the_middle_half():
    # means 0, 1, 2, 100: a quarter off each end leaves 1 and 2
    tasks = [[np.array([value, value])] for value in (100.0, 0.0, 2.0, 1.0)]
    iqm, interval = iqm_ci95(tasks, clip=UNCUT)
    # every episode of a task is the same, so there is nothing to be uncertain about
    assert (iqm, interval) == (1.5, (1.5, 1.5))
    # cut to 1.5 the means are 0, 1, 1.5, 1.5: 1 and 1.5 are left
    assert iqm_ci95(tasks) == (1.25, (1.25, 1.25))


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


RLIABLE = json.loads((Path(__file__).parent / "reference" / "rliable.json").read_text())


def by_task(matrix):
    return list(np.array(matrix).T)


@pytest.mark.parametrize("case", RLIABLE["cases"])
def test_points_and_intervals_are_those_of_rliable(case):
    """`scripts/rliable_numbers.py` made the numbers, with rliable 1.2.0 in an environment of its own."""
    ours, theirs = by_task(case["ours"]), by_task(case["theirs"])
    for name, value in case["points"].items():
        statistic = getattr(statistics, name)
        assert float(statistic(ours)) == pytest.approx(value, abs=1e-12)
        low, high = case["intervals"][name]
        # both bootstraps are drawn: each end to a twentieth of the width (ties make steps in coarse scores)
        ends = statistics.ci95(statistic, ours, reps=20_000)
        assert np.abs(np.array(ends) - [low, high]).max() < 0.05 * (high - low)
    assert float(statistics.improvement(ours, theirs)) == pytest.approx(case["improvement"], abs=1e-12)
    low, high = case["improvement_ci95"]
    ends = statistics.improvement_ci95(ours, theirs, reps=20_000)
    assert np.abs(np.array(ends) - [low, high]).max() < 0.05 * (high - low)
    thresholds = np.array(RLIABLE["thresholds"])
    assert statistics.profile(ours, thresholds) == pytest.approx(case["profile"], abs=1e-12)
    band = statistics.ci95(lambda drawn: statistics.profile(drawn, thresholds), ours, reps=20_000)
    # shares are multiples of one in runs x tasks: the ends may differ by one such step
    assert np.abs(np.array(band) - case["profile_ci95"]).max() <= 1.001 / sum(map(len, ours))


def test_teams_that_differ_by_a_constant_differ_surely_in_the_same_worlds():
    # worlds differ by 10, the teams by 0.5 in each world: paired, nothing is uncertain
    worlds = np.random.default_rng(3).normal(0, 10, (1, 320))
    difference, (low, high) = statistics.paired_difference(worlds + 0.5, worlds)
    assert (difference, low, high) == pytest.approx((0.5, 0.5, 0.5))
    with pytest.raises(ValueError, match="the same worlds"):
        statistics.paired_difference(worlds, worlds[:, :5])


def test_paired_interval_matches_scipy_for_one_run_each():
    chance = np.random.default_rng(4)
    ours, theirs = chance.normal(0.3, 1.0, (1, 200)), chance.normal(0.0, 1.0, (1, 200))
    _, interval = statistics.paired_difference(ours, theirs)
    expected = stats.bootstrap(
        ((ours - theirs)[0],), np.mean, method="percentile", n_resamples=20_000, rng=1
    ).confidence_interval
    width = expected.high - expected.low
    assert np.abs(np.array(interval) - expected).max() < 0.04 * width


def test_paired_runs_are_drawn_on_each_side():
    # runs differ with deviation 1, worlds not at all: the deviation of the difference is sqrt(1/30 + 1/30)
    chance = np.random.default_rng(5)
    ours, theirs = (np.tile(chance.normal(size=(30, 1)), 50) for _ in range(2))
    _, (low, high) = statistics.paired_difference(ours, theirs)
    spread = np.sqrt(ours[:, 0].var() / 30 + theirs[:, 0].var() / 30)
    assert high - low == pytest.approx(2 * 1.96 * spread, rel=0.1)


def test_chunks_do_not_change_an_interval(monkeypatch):
    scores = by_task(np.random.default_rng(6).normal(size=(5, 3)))
    whole = statistics.ci95(statistics.iqm, scores, reps=4000)
    monkeypatch.setattr(statistics, "_CHUNK", 1000)
    parts = statistics.ci95(statistics.iqm, scores, reps=4000)
    # another order of draws, the same law
    assert np.allclose(whole, parts, atol=0.1)
    assert statistics._chunks(10, 300) == [3, 3, 3, 1]


def entry(kind, score, split="standard"):
    whole = {"score_iqm": score, "score_iqm_ci95": [score, score] if score is not None else None}
    return {"suite": "standard", "split": split, "kind": kind, "aggregate": whole | {"scored": ["a", "b"]}}


def test_no_checkpoint_stands_above_a_method():
    standings = ranking.rank(
        {
            "lucky": entry("checkpoint", 0.9),
            "scripted": entry("reference", 1.0),
            "weak": entry("method", 0.2),
            "strong": entry("method", 0.6),
            "unscored": entry("checkpoint", None),
        }
    )
    assert [(one.name, one.place) for one in standings] == [
        ("strong", 1), ("weak", 2), ("lucky", 3), ("unscored", None), ("scripted", None),
    ]  # fmt: skip
    assert standings[0].ci95 == (0.6, 0.6)
    with pytest.raises(HipgError, match="of one suite and split"):
        ranking.rank({"a": entry("method", 0.1), "b": entry("method", 0.1, split="shift")})


def test_five_trainings_make_a_method():
    assert ranking.kind_of(False, [5, 7, 5]) == "method"
    assert ranking.kind_of(False, [5, 4, 5]) == ranking.kind_of(False, []) == "checkpoint"
    assert ranking.kind_of(True, [1, 1]) == "reference"


def rows_of(train_seeds, returns):
    return [
        {"train_seed": seed, "status": "ok", "return": float(value) + seed / 10}
        for seed in train_seeds
        for value in returns
    ]


def test_a_suite_of_methods_is_summed_up_by_runs():
    """Scores are returns here (anchors 0 and 1): task a 0.1 .. 0.5, b 2.1 .. 2.5, c unplayed."""
    zero, one = (Anchor(mean=mean, ci95=(mean, mean), episodes=1) for mean in (0.0, 1.0))
    specs = [
        task_spec(name).model_copy(update={"anchors": Anchors(random=zero, reference=one)})
        for name in ("hazard_nav-4", "hazard_nav-8", "coop_nav-3")
    ]
    low, high = rows_of(range(1, 6), [-0.1, 0.1]), rows_of(range(1, 6), [2.0])
    whole = aggregate([(specs[0], low), (specs[1], high), (specs[2], [])])
    # cut to 1.5, b is 1.5 five times; the unplayed task weighs as much as five runs of 0;
    # three of 15 go at each end
    assert whole["score_iqm"] == pytest.approx((0 + 0 + 0.1 + 0.2 + 0.3 + 0.4 + 0.5 + 1.5 + 1.5) / 9)
    assert whole["score_mean"] == pytest.approx((0.3 + 1.5 + 0.0) / 3)
    assert whole["score_median"] == pytest.approx(0.3)
    assert whole["optimality_gap"] == pytest.approx(1 - (0.3 + 1.0 + 0.0) / 3)
    assert (whole["counted_as_zero"], whole["runs"]) == (1, {"hazard_nav-4": 5, "hazard_nav-8": 5})
    low_end, high_end = whole["score_mean_ci95"]
    # only a varies: its mean of five draws from 0.1 .. 0.5 has deviation sqrt(0.02 / 5), a third of it counts
    assert high_end - low_end == pytest.approx(2 * 1.96 * np.sqrt(0.02 / 5) / 3, rel=0.1)
    share = dict(zip(whole["profile"]["thresholds"], whole["profile"]["share"], strict=True))
    assert (share[-0.5], share[0.25], share[1.5]) == (1.0, pytest.approx((3 / 5 + 1 + 0) / 3), 0.0)
    # with fewer runs there is an interval over episodes, and no others
    few = aggregate([(specs[0], rows_of([1], [-0.1, 0.1]))])
    assert few["score_mean_ci95"] is None
    assert few["score_iqm_ci95"] == pytest.approx([0.0, 0.2])
