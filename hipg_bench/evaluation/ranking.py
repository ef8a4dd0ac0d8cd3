"""Who stands where: methods by their interquartile mean, then checkpoints, never above a method."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, Literal, cast

import numpy as np

from hipg_bench.errors import HipgError
from hipg_bench.evaluation import statistics
from hipg_bench.evaluation.statistics import METHOD_RUNS, Interval, Scores

Kind = Literal["method", "checkpoint", "reference"]
"""A ``method`` was trained with at least 5 seeds for every task that it plays; a ``checkpoint`` with fewer.
A ``reference`` comes with the benchmark, is not trained, and has no place."""

ORDER: tuple[Kind, ...] = ("method", "checkpoint", "reference")
"""Of kinds in a table."""


@dataclasses.dataclass(frozen=True)
class Standing:
    """Where an entry stands.

    Attributes:
        name: whose.
        kind: what it is.
        place: from 1 on; None for references and for entries without a score.
        score: interquartile mean, or None.
        ci95: its interval, or None.
    """

    name: str
    kind: Kind
    place: int | None
    score: float | None
    ci95: Interval | None


def kind_of(builtin: bool, runs: Sequence[int]) -> Kind:
    """What an entry is, given its number of training seeds for each task that it plays."""
    if builtin:
        return "reference"
    return "method" if runs and min(runs) >= METHOD_RUNS else "checkpoint"


def rank(entries: Mapping[str, Mapping[str, Any]]) -> list[Standing]:
    """Order entries for a table: methods, checkpoints, references, the best of each first.

    Args:
        entries: name to what its ``results.json`` holds, all of the same suite and split.

    Raises:
        HipgError: results of different suites, splits or tasks.
    """
    what = {(r["suite"], r["split"], tuple(r["aggregate"]["scored"])) for r in entries.values()}
    if len(what) > 1:
        raise HipgError(f"results of one suite and split are ranked, got {sorted(what)}")
    standings: list[Standing] = []
    place = 0
    for kind in ORDER:
        group = [(name, r["aggregate"]) for name, r in entries.items() if r["kind"] == kind]
        group.sort(key=lambda one: (-_value(one[1]), one[0]))
        for name, whole in group:
            score, ends = whole["score_iqm"], whole["score_iqm_ci95"]
            placed = kind != "reference" and score is not None
            place += placed
            interval = cast(Interval, tuple(ends)) if ends else None
            standings.append(Standing(name, kind, place if placed else None, score, interval))
    return standings


def run_scores(results: Mapping[str, Any]) -> Scores:
    """Per scored task the score of every training run, cut to `statistics.CLIP`; 0 if unplayed."""
    played = {task["task"]: [run["score"] for run in task["runs"]] for task in results["tasks"]}
    return [np.clip(played.get(task, [0.0]), *statistics.CLIP) for task in results["aggregate"]["scored"]]


def better(ours: Mapping[str, Any], theirs: Mapping[str, Any]) -> tuple[float, Interval]:
    """Chance that a run of ours beats one of theirs on a task, with its interval; both are results."""
    a, b = run_scores(ours), run_scores(theirs)
    return float(statistics.improvement(a, b)), statistics.improvement_ci95(a, b)


def _value(whole: Mapping[str, Any]) -> float:
    score = whole["score_iqm"]
    return -np.inf if score is None else float(score)
