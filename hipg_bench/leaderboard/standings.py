"""The tables: who stands where on a split and a family, with intervals, computed from the rows."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

from hipg_bench import registry
from hipg_bench.evaluation import splits
from hipg_bench.evaluation.results import aggregate
from hipg_bench.leaderboard.shown import Shown
from hipg_bench.spec import TaskSpec

ALL = "all"
"""The table over all families."""


@dataclasses.dataclass(frozen=True)
class Line:
    """A line of a table.

    Attributes:
        shown: whose.
        rank: from 1; None for references.
        score, ci95: interquartile mean over the tasks, and its interval.
        survival: share of agents alive at the end, mean over tasks.
        deaths: per episode, mean over tasks.
        played, tasks: tasks that were played, and that there are.
        dnf: tasks in which too many episodes failed.
        failed: episodes that failed.
        public: the score on public worlds, where ``score`` is of hidden ones.
    """

    shown: Shown
    rank: int | None
    score: float
    ci95: tuple[float, float]
    survival: float | None
    deaths: float | None
    played: int
    tasks: int
    dnf: int
    failed: int
    public: float | None


@dataclasses.dataclass(frozen=True)
class Panel:
    """The tables of a split and a family: scores of hidden worlds, and of public ones."""

    split: str
    family: str
    verified: Sequence[Line]
    reported: Sequence[Line]


def panels(entries: Sequence[Shown], specs: Sequence[TaskSpec]) -> list[Panel]:
    """Every table there is something to say in."""
    families = [ALL, *dict.fromkeys(spec.family for spec in specs)]
    return [
        _panel(entries, specs, split, family)
        for split in splits.SPLITS
        if any(_scored(one, split) for one in entries)
        for family in families
    ]


def _panel(entries: Sequence[Shown], specs: Sequence[TaskSpec], split: str, family: str) -> Panel:
    chosen = [spec for spec in specs if family in (ALL, spec.family)]
    there = [one for one in entries if _scored(one, split)]
    return Panel(
        split,
        family,
        _ranked([_line(one, chosen, split) for one in there if one.worlds == "hidden"]),
        _ranked([_line(one, chosen, split) for one in there if one.worlds == "public"]),
    )


def _scored(one: Shown, split: str) -> bool:
    """Whether an entry played a split whose anchors are measured."""
    result = one.result(split)
    return result is not None and result["aggregate"]["score_iqm"] is not None


def _line(one: Shown, specs: Sequence[TaskSpec], split: str) -> Line:
    names = [spec.task for spec in specs]
    result = one.result(split) or {}
    tasks = [task for task in result["tasks"] if task["task"] in names]
    whole = score_of(one, tuple(names), split, one.worlds)
    public = (
        score_of(one, tuple(names), split, "public")[0]
        if one.worlds == "hidden" and ("public", split) in one.results
        else None
    )
    return Line(
        shown=one,
        rank=None,
        score=whole[0],
        ci95=whole[1],
        survival=_mean([task["survival"] for task in tasks]),
        deaths=_mean([task["deaths"] for task in tasks]),
        played=len(tasks),
        tasks=len(names),
        dnf=sum(task["dnf"] for task in tasks),
        failed=sum(sum(task["failures"].values()) for task in tasks),
        public=public,
    )


def _ranked(lines: Sequence[Line]) -> list[Line]:
    """Best first; references stand among the others and have no rank."""
    ordered = sorted(lines, key=lambda line: (-line.score, line.shown.name))
    ranks = iter(range(1, len(ordered) + 1))
    return [
        line if line.shown.kind == "reference" else dataclasses.replace(line, rank=next(ranks))
        for line in ordered
    ]


def score_of(
    one: Shown, tasks: tuple[str, ...], split: str, worlds: Any
) -> tuple[float, tuple[float, float]]:
    """Interquartile mean of an entry's scores over tasks, with a 95 % interval; unplayed tasks count as 0."""
    specs = [splits.with_anchors(split, registry.task_spec(task)) for task in tasks]
    played = {task["task"] for task in one.results[worlds, split]["tasks"]}
    found = aggregate(
        [(spec, one.rows(worlds, split, spec.task) if spec.task in played else []) for spec in specs]
    )
    low, high = found["score_iqm_ci95"]
    return found["score_iqm"], (low, high)


def _mean(values: Sequence[float | None]) -> float | None:
    defined = [value for value in values if value is not None]
    return float(np.mean(defined)) if defined else None
