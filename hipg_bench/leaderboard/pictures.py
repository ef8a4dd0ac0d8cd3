"""What each page shows beside its words: charts, matrices and films, made from entries."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

from hipg_bench.evaluation import splits
from hipg_bench.evaluation.ranking import better
from hipg_bench.evaluation.statistics import CLIP, Interval
from hipg_bench.leaderboard.charts import Chart, Series, chart
from hipg_bench.leaderboard.entry_view import EntryView
from hipg_bench.leaderboard.standings import Line, Panel
from hipg_bench.spec import TaskSpec

COLOURS = 8
"""Entries that a chart can tell apart."""


@dataclasses.dataclass(frozen=True)
class Better:
    """How sure it is that the entry of a row beats that of a column, on a task drawn at random.

    Attributes:
        names: of rows and columns.
        shares: by row, then column, each with its interval; None on the diagonal.
    """

    names: Sequence[str]
    shares: Sequence[Sequence[tuple[float, Interval] | None]]


def drawn(panel: Panel) -> list[EntryView]:
    """The best entries, and all references, in the order of the table."""
    lines = [*panel.verified, *panel.reported]
    best = sorted((line for line in lines if line.rank is not None), key=lambda line: -line.score)[:COLOURS]
    kept = {line.view.name for line in best} | {line.view.name for line in lines if line.rank is None}
    return [line.view for line in lines if line.view.name in kept]


def colours(entries: Sequence[EntryView]) -> dict[str, str]:
    """Entry to its class in the style sheet, the same on all pages."""
    found: dict[str, str] = {}
    for one in entries:
        reference = one.kind == "reference"
        many = sum(("reference" in colour) == reference for colour in found.values())
        found[one.name] = f"reference r{many % 4}" if reference else f"c{many}"
    return found


def overview(panels: Sequence[Panel], specs: Sequence[TaskSpec]) -> dict[str, Any]:
    """What the front page shows: per split a performance profile, P(improvement), and scores by task."""
    main = [panel for panel in panels if panel.family == "all"]
    entries = drawn(main[0]) if main else []
    colour = colours(entries)
    return {
        "colour": colour,
        "profiles": {panel.split: _profile(_lines(panel, colour), colour) for panel in main},
        "better": {panel.split: _better(_lines(panel, colour)) for panel in main},
        "lines": {panel.split: [*panel.verified, *panel.reported] for panel in main},
        "cards": [(spec, _best_film(main[0], spec)) for spec in specs] if main else [],
    }


def task(entries: Sequence[EntryView], on_page: Sequence[EntryView], spec: TaskSpec) -> dict[str, Any]:
    """What a task's page shows."""
    colour = colours(on_page)
    players = [one for one in on_page if one.task("standard", spec.task) is not None]
    found = [(one, one.task(split, spec.task), split) for split in splits.SPLITS for one in entries]
    return {
        "colour": colour,
        "players": players,
        "films": [(one, one.films[spec.task]) for one in players if spec.task in one.films],
        "scores": {
            split: sorted(
                [(one, numbers) for one, numbers, where in found if numbers is not None and where == split],
                key=lambda pair: -pair[1]["return_mean"],
            )
            for split in splits.SPLITS
        },
        "learning": _learning(players, spec, colour),
        "by_deaths": _by_deaths(players, spec, colour),
    }


def agent(one: EntryView, specs: Sequence[TaskSpec]) -> dict[str, Any]:
    """What an entry's page shows."""
    colour = {one.name: "c0"}
    by_task = {
        spec.task: {split: one.task(split, spec.task) for split in splits.SPLITS if one.result(split)}
        for spec in specs
    }
    return {
        "by_task": {name: found for name, found in by_task.items() if any(found.values())},
        "unplayed": (one.result("standard") or {"skipped": []})["skipped"],
        "curves": [
            (spec, learning)
            for spec in specs
            if (learning := _learning([one], spec, colour, alone=True)) is not None
        ],
        "specs": {spec.task: spec for spec in specs},
    }


def _lines(panel: Panel, colour: Mapping[str, str]) -> list[Line]:
    """The lines of a table that charts show."""
    return [line for line in (*panel.verified, *panel.reported) if line.view.name in colour]


def _profile(lines: Sequence[Line], colour: Mapping[str, str]) -> Chart | None:
    """Share of (task, trained policy) whose score is above a threshold, over the threshold."""
    series: list[Series] = []
    for line in lines:
        profile = line.result["aggregate"]["profile"]
        points = list(zip(profile["thresholds"], profile["share"], strict=True))
        series.append(Series(line.view.name, colour[line.view.name], points, stairs=True))
    return chart(
        series, x_label="score", y_label="share above it", x_limits=CLIP, y_limits=(0.0, 1.02), legend=True
    )  # fmt: skip


def _better(lines: Sequence[Line]) -> Better:
    return Better(
        [line.view.name for line in lines],
        [[None if a is b else better(a.result, b.result) for b in lines] for a in lines],
    )


def _best_film(panel: Panel, spec: TaskSpec) -> tuple[EntryView, Line] | None:
    """Who of the ranked has the best film of a task."""
    lines = [line for line in (*panel.verified, *panel.reported) if spec.task in line.view.films]
    ranked = [line for line in lines if line.rank is not None and line.view.task("standard", spec.task)]
    best = max(ranked, key=lambda line: line.view.task("standard", spec.task)["return_mean"], default=None)  # type: ignore[index]
    return (best.view, best) if best else None


def _learning(
    entries: Sequence[EntryView], spec: TaskSpec, colour: Mapping[str, str], *, alone: bool = False
) -> Chart | None:
    """Return over environment steps, a curve per trained policy."""
    series = [
        Series(f"seed {seed}" if alone else one.name, colour[one.name], points)
        for one in entries
        for curves in [one.curves.get(spec.task, {})]
        for seed, points in curves.items()
        if len(points) > 1
    ]
    return chart(series, x_label="environment steps", y_label="team return", levels=_anchors(spec))


def _by_deaths(entries: Sequence[EntryView], spec: TaskSpec, colour: Mapping[str, str]) -> Chart | None:
    """Mean return of the episodes in which so many agents died."""
    series: list[Series] = []
    for one in entries:
        found = (one.task("standard", spec.task) or {"return_by_deaths": []})["return_by_deaths"]
        whole = sum(group["episodes"] for group in found)
        points = [(float(group["deaths"]), float(group["return_mean"])) for group in found]
        weights = [group["episodes"] / whole for group in found]
        series.append(Series(one.name, colour[one.name], points, weights))
    return chart(series, x_label="agents that died", y_label="team return", whole_x=True)


def _anchors(spec: TaskSpec) -> list[tuple[str, float]]:
    if spec.anchors is None:
        return []
    return [("random", spec.anchors.random.mean), ("reference", spec.anchors.reference.mean)]
