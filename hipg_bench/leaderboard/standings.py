"""The tables: who stands where on a split and a family, with intervals, computed from the rows."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from hipg_bench.evaluation import splits
from hipg_bench.evaluation.ranking import rank
from hipg_bench.evaluation.results import aggregate
from hipg_bench.leaderboard.entry_view import EntryView
from hipg_bench.leaderboard.playing import ALL
from hipg_bench.spec import TaskSpec


@dataclasses.dataclass(frozen=True)
class Line:
    """A line of a table.

    Attributes:
        view: whose.
        result: its results on the split, with the table's tasks only.
        rank: from 1; None for references.
        survival: share of agents alive at the end, mean over tasks.
        deaths: per episode, mean over tasks.
        tasks: how many there are.
        public: the score on public worlds, where that of hidden ones counts and the table has all families.
    """

    view: EntryView
    result: Mapping[str, Any]
    rank: int | None
    survival: float | None
    deaths: float | None
    tasks: int
    public: float | None

    @property
    def score(self) -> float:
        """Interquartile mean over the tasks; unplayed ones count as 0."""
        return self.result["aggregate"]["score_iqm"]

    @property
    def comparable(self) -> bool:
        """Whether the score means something: not that of a reference which is made for some tasks only."""
        return self.view.kind != "reference" or self.played == self.tasks

    @property
    def ci95(self) -> Sequence[float]:
        """Its 95 % interval."""
        return self.result["aggregate"]["score_iqm_ci95"]

    @property
    def played(self) -> int:
        """Tasks that were played."""
        return len(self.result["tasks"])

    @property
    def dnf(self) -> int:
        """Tasks in which too many episodes failed."""
        return sum(task["dnf"] for task in self.result["tasks"])

    @property
    def failed(self) -> int:
        """Episodes that failed."""
        return sum(sum(task["failures"].values()) for task in self.result["tasks"])


@dataclasses.dataclass(frozen=True)
class Panel:
    """The tables of a split and a family: scores of hidden worlds, and of public ones."""

    split: str
    family: str
    verified: Sequence[Line]
    reported: Sequence[Line]


def panels(entries: Sequence[EntryView], specs: Sequence[TaskSpec]) -> list[Panel]:
    """Every table there is something to say in."""
    families = [ALL, *dict.fromkeys(spec.family for spec in specs)]
    return [
        _panel(entries, specs, split, family)
        for split in splits.SPLITS
        if any(_scored(one, split) for one in entries)
        for family in families
    ]


def _panel(entries: Sequence[EntryView], specs: Sequence[TaskSpec], split: str, family: str) -> Panel:
    chosen = [splits.with_anchors(split, spec) for spec in specs if family in (ALL, spec.family)]
    there = [one for one in entries if _scored(one, split)]
    return Panel(
        split,
        family,
        _ranked([_line(one, chosen, split, family) for one in there if one.worlds == "hidden"]),
        _ranked([_line(one, chosen, split, family) for one in there if one.worlds == "public"]),
    )


def _scored(one: EntryView, split: str) -> bool:
    """Whether an entry played a split whose anchors are measured."""
    result = one.result(split)
    return result is not None and result["aggregate"]["score_iqm"] is not None


def _line(one: EntryView, specs: Sequence[TaskSpec], split: str, family: str) -> Line:
    names = [spec.task for spec in specs]
    result = dict(one.result(split) or {})
    tasks = [task for task in result["tasks"] if task["task"] in names]
    anchored = [spec.task for spec in specs if spec.anchors]
    if one.worlds == "hidden":
        result |= {"tasks": tasks, "aggregate": result["tables"][family], "kind": one.kind}
    elif result["aggregate"]["scored"] != anchored:
        played = {task["task"] for task in tasks}
        rows = [
            (spec, one.rows(one.worlds, split, spec.task) if spec.task in played else []) for spec in specs
        ]
        result |= {"tasks": tasks, "aggregate": aggregate(rows), "kind": one.kind}
    public = one.results.get(("public", split)) if one.worlds == "hidden" and family == ALL else None
    return Line(
        view=one,
        result=result,
        rank=None,
        survival=_mean([task["survival"] for task in tasks]),
        deaths=_mean([task["deaths"] for task in tasks]),
        tasks=len(names),
        public=public["aggregate"]["score_iqm"] if public else None,
    )


def _ranked(lines: Sequence[Line]) -> list[Line]:
    """In the order of the protocol: methods, checkpoints, references."""
    named = {line.view.name: line for line in lines}
    standings = rank({name: line.result for name, line in named.items()})
    return [dataclasses.replace(named[one.name], rank=one.place) for one in standings]


def _mean(values: Sequence[float | None]) -> float | None:
    defined = [value for value in values if value is not None]
    return float(np.mean(defined)) if defined else None
