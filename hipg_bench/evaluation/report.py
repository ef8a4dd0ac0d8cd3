"""``report.html``: one page that opens offline, with tables, distributions and the films beside it."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jinja2
import numpy as np

from hipg_bench.evaluation.episodes import Row
from hipg_bench.evaluation.words import end_reason, metric
from hipg_bench.spec import TaskSpec

_BINS = 36
_TIMES = 25
_WIDTH, _HEIGHT = 360.0, 96.0
"""Drawing area of a distribution, in SVG units; the template uses the same."""


@dataclasses.dataclass(frozen=True)
class Mark:
    """A labelled place on an axis, and its value."""

    x: float
    label: str
    value: str


@dataclasses.dataclass(frozen=True)
class Bar:
    """A bar of a distribution, in SVG units from the top left; ``says`` is shown on hover."""

    x: float
    y: float
    width: float
    height: float
    says: str


@dataclasses.dataclass(frozen=True)
class Chart:
    """A distribution: bars, labelled lines, and the axis' ends."""

    bars: Sequence[Bar]
    marks: Sequence[Mark]
    low: str
    high: str


def render(
    results: Mapping[str, Any], rows: Mapping[str, Sequence[Row]], specs: Mapping[str, TaskSpec]
) -> str:
    """Return the page.

    Args:
        results: what ``results.json`` holds.
        rows: task to its episodes.
        specs: task to its spec.
    """
    loader = jinja2.FileSystemLoader(Path(__file__).parent)
    environment = jinja2.Environment(
        loader=loader, autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    tasks = [
        {
            "numbers": task,
            "spec": specs[task["task"]],
            "returns": _returns(specs[task["task"]], rows[task["task"]]),
            "deaths": _deaths(specs[task["task"]], rows[task["task"]]),
            "films": [film for film in results["films"] if film["task"] == task["task"]],
        }
        for task in results["tasks"]
    ]
    page = environment.get_template("report.html.j2")
    return page.render(
        end_reason=end_reason,
        metric=metric,
        results=results,
        tasks=tasks,
        place=_place,
        width=_WIDTH,
        height=_HEIGHT,
    )


def _place(score: float) -> float:
    """Where a score stands on the score axis, in percent; the axis runs from -0.25 to 1.25."""
    return round(100 * min(max((score + 0.25) / 1.5, 0.0), 1.0), 2)


def _returns(spec: TaskSpec, rows: Sequence[Row]) -> Chart:
    """How the episodes' returns are spread, between the anchors."""
    values = np.array([row["return"] for row in rows])
    anchors = (
        {"random": spec.anchors.random.mean, "reference": spec.anchors.reference.mean} if spec.anchors else {}
    )
    low = min(values.min(), *anchors.values()) if anchors else values.min()
    high = max(values.max(), *anchors.values()) if anchors else values.max()
    span = max(high - low, 1e-9)
    counts, edges = np.histogram(values, _BINS, (low, low + span))
    marks = [Mark(_WIDTH * (at - low) / span, name, f"{at:.1f}") for name, at in anchors.items()]
    marks.append(Mark(_WIDTH * (values.mean() - low) / span, "mean", f"{values.mean():.1f}"))
    says = [
        f"{count} episodes in {a:.1f} .. {b:.1f}"
        for count, a, b in zip(counts, edges, edges[1:], strict=False)
    ]
    return Chart(_bars(counts, says), marks, f"{low:.1f}", f"{low + span:.1f}")


def _deaths(spec: TaskSpec, rows: Sequence[Row]) -> Chart | None:
    """When agents died, over the longest possible episode; None if nobody did."""
    times = [death["time"] for row in rows for death in row["death_list"]]
    if not times:
        return None
    end = spec.horizon * spec.control_step
    counts, edges = np.histogram(times, _TIMES, (0.0, end))
    says = [
        f"{count} deaths in {a:.1f} .. {b:.1f} s"
        for count, a, b in zip(counts, edges, edges[1:], strict=False)
    ]
    return Chart(_bars(counts, says), (), "0 s", f"{end:g} s")


def _bars(counts: np.ndarray, says: Sequence[str]) -> list[Bar]:
    """Bars side by side, the tallest as high as the area."""
    width = _WIDTH / len(counts)
    heights = _HEIGHT * counts / counts.max()
    return [
        Bar(round(i * width, 2), round(_HEIGHT - height, 2), round(width - 1.0, 2), round(height, 2), text)
        for i, (height, text) in enumerate(zip(heights.tolist(), says, strict=True))
    ]
