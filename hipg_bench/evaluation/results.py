"""From rows to ``results.json``, of a task and of a suite; see ``docs/concepts/protocol.md``."""

from __future__ import annotations

import collections
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from hipg_bench.evaluation import statistics
from hipg_bench.evaluation.episodes import Row
from hipg_bench.evaluation.failures import NOT_PLAYED, OK, failures_of_a_dnf
from hipg_bench.evaluation.statistics import Runs, mean_ci95
from hipg_bench.spec import TaskSpec

SCHEMA = 2
"""Raised when a field of ``results.json`` or of a row changes its meaning."""


def summarise(spec: TaskSpec, rows: Sequence[Row]) -> dict[str, Any]:
    """Everything about one task; numbers per episode are means over played episodes.

    ``survival`` is the share of agents alive at the end, ``deaths`` how many died, ``first_death`` the
    time in s where somebody did, ``score`` the mean return on the anchors' scale.
    """
    runs = _by_seed(rows)
    mean, interval = mean_ci95([_returns(spec, run) for run in runs.values()])
    anchored = spec.anchors is not None
    played = [row for row in rows if row["status"] != NOT_PLAYED]
    return {
        "task": spec.task,
        "version": spec.version,
        "fingerprint": spec.fingerprint,
        "num_agents": spec.num_agents,
        "episodes": len(rows),
        "train_seeds": sorted(runs),
        "runs": [_run(spec, train_seed, run) for train_seed, run in runs.items()],
        "dnf": any(_dnf(run) for run in runs.values()),
        "return_mean": mean,
        "return_ci95": list(interval),
        "score": spec.score(mean) if anchored else None,
        "score_ci95": [spec.score(end) for end in interval] if anchored else None,
        "survival": _mean(row["survival"] for row in rows),
        "deaths": _mean(row["deaths"] for row in rows),
        "first_death": _mean(row["first_death"] for row in rows),
        "length": _mean(row["length"] for row in rows),
        "return_by_deaths": _by_deaths(played),
        "physics": sum(row["end_reason"] == "physics" for row in rows),
        "failures": _count(row["status"] for row in rows if row["status"] != OK),
        "end_reasons": _count(row["end_reason"] for row in played),
        "death_causes": _count(death["cause"] for row in rows for death in row["death_list"]),
        "metrics": {name: _mean(row["metrics"][name] for row in rows) for name in rows[0]["metrics"]},
        "anchors": spec.anchors.model_dump(mode="json") if spec.anchors else None,
    }


def aggregate(played: Sequence[tuple[TaskSpec, Sequence[Row]]]) -> dict[str, Any]:
    """The whole suite in a few numbers; tasks without anchors are left out, unplayed ones count as 0.

    Scores of runs are cut to `statistics.CLIP`. With at least `METHOD_RUNS` training seeds for every task
    played, intervals are over training seeds; with fewer there is one for the interquartile mean only, over
    episodes.
    """
    scored = [(spec, rows) for spec, rows in played if spec.anchors is not None]
    names = [spec.task for spec, _ in scored]
    runs = {spec.task: len(_by_seed(rows)) for spec, rows in scored if rows}
    whole: dict[str, Any] = {
        "tasks": len(scored), "scored": names, "counted_as_zero": len(scored) - len(runs), "runs": runs,
        "score_iqm": None, "score_iqm_ci95": None,
    }  # fmt: skip
    if not scored:
        return whole
    episodes = [_scores(spec, rows) for spec, rows in scored]
    scores = [np.clip([run.mean() for run in task], *statistics.CLIP) for task in episodes]
    method = bool(runs) and min(runs.values()) >= statistics.METHOD_RUNS
    for name, statistic in _STATISTICS.items():
        whole[name] = float(statistic(scores))
        whole[f"{name}_ci95"] = [float(end) for end in statistics.ci95(statistic, scores)] if method else None
    if not method:
        whole["score_iqm_ci95"] = list(statistics.iqm_ci95(episodes)[1])
    whole["profile"] = _profile(scores, method)
    return whole


_STATISTICS = {
    "score_iqm": statistics.iqm,
    "score_mean": statistics.mean,
    "score_median": statistics.median,
    "optimality_gap": statistics.optimality_gap,
}
"""Numbers of a suite by their name in ``results.json``."""
_THRESHOLDS = np.linspace(*statistics.CLIP, 41)
"""Scores at which a performance profile is told."""


def _profile(scores: statistics.Scores, method: bool) -> dict[str, Any]:
    """Share of (run, task) scores above each threshold, with its band for methods."""

    def share(drawn: statistics.Drawn) -> np.ndarray:
        return statistics.profile(drawn, _THRESHOLDS)

    return {
        "thresholds": np.round(_THRESHOLDS, 6).tolist(),
        "share": share(scores).tolist(),
        "ci95": [end.tolist() for end in statistics.ci95(share, scores, reps=2000)] if method else None,
    }


def _scores(spec: TaskSpec, rows: Sequence[Row]) -> Runs:
    """Scores of every episode, an array per training seed."""
    if not rows:
        return [np.zeros(1)]
    return [np.array([spec.score(value) for value in _returns(spec, run)]) for run in _by_seed(rows).values()]


def _returns(spec: TaskSpec, run: Sequence[Row]) -> np.ndarray:
    """What a run's episodes count: after a DNF the floor, whatever they reached."""
    return np.array([spec.floor if _dnf(run) else row["return"] for row in run])


def _dnf(run: Sequence[Row]) -> bool:
    """Whether too many of a run's episodes failed."""
    return sum(row["status"] != OK for row in run) >= failures_of_a_dnf(len(run))


def _run(spec: TaskSpec, train_seed: int, run: Sequence[Row]) -> dict[str, Any]:
    """What one trained policy reached."""
    mean = float(_returns(spec, run).mean())
    return {
        "train_seed": train_seed,
        "return_mean": mean,
        "score": spec.score(mean) if spec.anchors else None,
        "dnf": _dnf(run),
    }


def _by_seed(rows: Sequence[Row]) -> dict[int, list[Row]]:
    """Rows of each training seed."""
    runs: dict[int, list[Row]] = {}
    for row in rows:
        runs.setdefault(row["train_seed"], []).append(row)
    return dict(sorted(runs.items()))


def _by_deaths(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """Mean return of the episodes in which so many agents died."""
    returns: dict[int, list[float]] = {}
    for row in rows:
        returns.setdefault(row["deaths"], []).append(row["return"])
    return [
        {"deaths": deaths, "episodes": len(values), "return_mean": float(np.mean(values))}
        for deaths, values in sorted(returns.items())
    ]


def _mean(values: Iterable[float | None]) -> float | None:
    """Mean of what is defined."""
    defined = [value for value in values if value is not None]
    return float(np.mean(defined)) if defined else None


def _count(names: Iterable[str]) -> dict[str, int]:
    return dict(sorted(collections.Counter(names).items()))
