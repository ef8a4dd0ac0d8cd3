"""From rows to numbers: what ``results.json`` says of a task and of a suite."""

from __future__ import annotations

import collections
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from hipg_bench.evaluation.episodes import Row
from hipg_bench.evaluation.statistics import Runs, iqm_ci95, mean_ci95
from hipg_bench.spec import TaskSpec

SCHEMA = 1
"""Raised when a field of ``results.json`` or of a row changes its meaning."""


def summarise(spec: TaskSpec, rows: Sequence[Row]) -> dict[str, Any]:
    """Everything about one task; numbers per episode are means over episodes.

    ``survival`` is the share of agents alive at the end, ``deaths`` how many died, ``first_death`` the
    time in s where somebody did, ``score`` the mean return on the anchors' scale.
    """
    runs = _runs(rows, "return")
    mean, interval = mean_ci95(runs)
    anchored = spec.anchors is not None
    return {
        "task": spec.task,
        "version": spec.version,
        "fingerprint": spec.fingerprint,
        "num_agents": spec.num_agents,
        "episodes": len(rows),
        "train_seeds": sorted({row["train_seed"] for row in rows}),
        "return_mean": mean,
        "return_ci95": list(interval),
        "score": spec.score(mean) if anchored else None,
        "score_ci95": [spec.score(end) for end in interval] if anchored else None,
        "survival": _mean(row["survival"] for row in rows),
        "deaths": _mean(row["deaths"] for row in rows),
        "first_death": _mean(row["first_death"] for row in rows),
        "length": _mean(row["length"] for row in rows),
        "end_reasons": _count(row["end_reason"] for row in rows),
        "death_causes": _count(death["cause"] for row in rows for death in row["death_list"]),
        "metrics": {name: _mean(row["metrics"][name] for row in rows) for name in rows[0]["metrics"]},
        "anchors": spec.anchors.model_dump(mode="json") if spec.anchors else None,
    }


def aggregate(played: Sequence[tuple[TaskSpec, Sequence[Row]]]) -> dict[str, Any]:
    """Interquartile mean of the score over tasks that have anchors; unplayed ones count as 0, as random."""
    scored = [rows for spec, rows in played if spec.anchors is not None]
    missing = sum(not rows for rows in scored)
    if not scored:
        return {"score_iqm": None, "score_iqm_ci95": None, "tasks": 0, "counted_as_zero": 0}
    iqm, interval = iqm_ci95([_runs(rows, "score") if rows else [np.zeros(1)] for rows in scored])
    return {
        "score_iqm": iqm, "score_iqm_ci95": list(interval), "tasks": len(scored), "counted_as_zero": missing,
    }  # fmt: skip


def _runs(rows: Sequence[Row], name: str) -> Runs:
    """One quantity of every episode, an array per training seed."""
    seeds = sorted({row["train_seed"] for row in rows})
    return [np.array([row[name] for row in rows if row["train_seed"] == seed]) for seed in seeds]


def _mean(values: Iterable[float | None]) -> float | None:
    """Mean of what is defined."""
    defined = [value for value in values if value is not None]
    return float(np.mean(defined)) if defined else None


def _count(names: Iterable[str]) -> dict[str, int]:
    return dict(sorted(collections.Counter(names).items()))
