"""A picture of how speed scales, from the bench's document."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, NullFormatter, PercentFormatter

from hipg_bench.errors import HipgError
from hipg_bench.paths import replacing

Rows = Sequence[Mapping[str, Any]]

_INK, _FAINT = "#1d2733", "#9aa5b1"
_HUES = {
    "paper": "Blues", "planar": "Reds", "multiwalker": "Purples", "comm": "Oranges", "nav": "Greens",
    "": "Greys",
}  # fmt: skip
"""By the first of these that a task's name holds; tasks of a hue are shades of it."""
_STYLE: dict[Any, Any] = {
    "font.size": 11, "axes.spines.top": False, "axes.spines.right": False, "axes.edgecolor": _FAINT,
    "axes.labelcolor": _INK, "text.color": _INK, "xtick.color": _INK, "ytick.color": _INK,
    "axes.titlesize": 13, "axes.titleweight": "bold", "axes.titlelocation": "left", "axes.titlepad": 12,
    "axes.grid": True, "grid.color": "#e6eaee", "axes.axisbelow": True, "legend.frameon": False,
}  # fmt: skip
_LINE = 0.034
"""Height of a line of text, in heights of the axes."""
_RESOLUTION = 160
"""Dots per inch."""


def draw(document: Mapping[str, Any], path: Path) -> None:
    """Draw what the document holds of steps and scaling, side by side.

    Args:
        document: of a bench.
        path: its ending chooses the format.

    Raises:
        HipgError: the document has neither section.
    """
    panels = _panels(document["sections"])
    if not panels:
        raise HipgError("a plot needs the section steps or scaling, with more than one batch size")
    with matplotlib.rc_context(_STYLE):
        figure = Figure(figsize=(6.6 * len(panels), 6.0), layout="constrained")
        axes: Sequence[Axes] = figure.subplots(1, len(panels), squeeze=False)[0]
        for panel, place in zip(panels, axes, strict=True):
            panel(place)
        host = document["machine"]
        figure.supxlabel(
            f"{host['processor']}, {host['cores']} cores", fontsize=9, color=_FAINT, x=0.99, ha="right"
        )
        with replacing(path) as temporary:
            key = "Software" if path.suffix.lower() == ".png" else "Creator"
            figure.savefig(temporary, dpi=_RESOLUTION, metadata={key: "hipg-bench"})


def _panels(sections: Mapping[str, Rows]) -> list[Callable[[Axes], None]]:
    """What there is to draw."""
    steps, scaling = sections.get("steps", []), sections.get("scaling", [])
    over_agents = [row for row in scaling if row["sweep"] == "agents"]
    threads = max((row["threads"] for row in steps), default=0)
    steps = [row for row in steps if row["threads"] == threads]
    top = max((row["num_envs"] for row in steps), default=0)
    panels: list[Callable[[Axes], None]] = []
    if len({row["num_envs"] for row in steps}) > 1:
        panels.append(lambda axes: _rates(axes, steps))
    if steps:
        panels.append(lambda axes: _shares(axes, [row for row in steps if row["num_envs"] == top]))
    if over_agents:
        panels.append(lambda axes: _costs(axes, over_agents))
    return panels


def _rates(axes: Axes, rows: Rows) -> None:
    """Rate against the number of worlds."""
    colour = _colours(rows)
    ends: list[tuple[float, str]] = []
    for task, points in _by_task(rows).items():
        worlds, rate = [row["num_envs"] for row in points], [row["env_steps"] for row in points]
        axes.plot(worlds, rate, "o-", color=colour[task], markersize=5, linewidth=2)
        ends.append((rate[-1], task))
    axes.set(
        xscale="log", yscale="log", xlabel="worlds side by side", title="Control steps per second, all worlds"
    )
    axes.set_xticks(sorted({row["num_envs"] for row in rows}))
    axes.tick_params(axis="x", which="minor", bottom=False)
    axes.xaxis.set_major_formatter(FuncFormatter(_whole))
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.yaxis.set_major_formatter(FuncFormatter(_whole))
    last = max(row["num_envs"] for row in rows)
    for height, (_, task) in zip(
        _spread(axes, [rate for rate, _ in sorted(ends)]), sorted(ends), strict=True
    ):
        axes.annotate(
            task, (last, height), xytext=(9, 0), textcoords="offset points", va="center", fontsize=9,
            color=colour[task], annotation_clip=False,
        )  # fmt: skip


def _spread(axes: Axes, values: Sequence[float]) -> list[float]:
    """Heights for labels on a logarithmic axis, moved apart where they would meet; values ascend."""
    low, high = axes.get_ylim()
    gap = math.log(high / low) * _LINE
    logs = [math.log(value) for value in values]
    pushed_up, pushed_down = _stacked(logs, gap), [-x for x in _stacked([-x for x in reversed(logs)], gap)]
    return [math.exp((up + down) / 2) for up, down in zip(pushed_up, reversed(pushed_down), strict=True)]


def _stacked(values: Sequence[float], gap: float) -> list[float]:
    """Ascending values, each at least a gap above the one before."""
    out: list[float] = []
    for value in values:
        out.append(max(value, out[-1] + gap) if out else value)
    return out


def _shares(axes: Axes, rows: Rows) -> None:
    """Share of raw physics, a bar per task."""
    rows = sorted(rows, key=lambda row: row["share"])
    colour = _colours(rows)
    bars = axes.barh(
        [row["task"] for row in rows], [row["share"] for row in rows],
        color=[colour[row["task"]] for row in rows], height=0.72,
    )  # fmt: skip
    axes.bar_label(bars, [f"{row['share']:.0%}" for row in rows], padding=4, fontsize=9)
    axes.set(xlim=(0, 1.08), title=f"Share of raw mujoco.batch, {rows[0]['num_envs']:,} worlds")
    axes.xaxis.set_major_formatter(PercentFormatter(1.0))
    axes.grid(visible=False, axis="y")
    axes.tick_params(axis="y", length=0)


def _costs(axes: Axes, rows: Rows) -> None:
    """Cost of a step against the number of agents."""
    sizes = sorted({row["num_agents"] for row in rows})
    axes.plot(sizes, [size / sizes[0] for size in sizes], "--", color=_FAINT, label="as the number of agents")
    colour = _colours(rows)
    for task, points in _by_task(rows).items():
        axes.plot(
            [row["num_agents"] for row in points], [row["growth"] for row in points], "o-",
            color=colour[task], markersize=5, linewidth=2, label=task.rpartition("-")[0],
        )  # fmt: skip
    axes.set(
        xscale="log", yscale="log", xlabel="agents",
        title=f"Time of a step, relative to {sizes[0]} agents",
    )  # fmt: skip
    axes.set_xticks(sizes)
    axes.tick_params(axis="x", which="minor", bottom=False)
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_formatter(FuncFormatter(_whole))
        axis.set_minor_formatter(NullFormatter())
    axes.legend(loc="upper left")


def _by_task(rows: Rows) -> dict[str, list[Mapping[str, Any]]]:
    return {
        task: [row for row in rows if row["task"] == task]
        for task in dict.fromkeys(row["task"] for row in rows)
    }


def _colours(rows: Rows) -> dict[str, Any]:
    """A shade per task."""
    alike: dict[str, list[str]] = {}
    for task in sorted({row["task"] for row in rows}):
        alike.setdefault(next(hue for word, hue in _HUES.items() if word in task), []).append(task)
    return {
        task: matplotlib.colormaps[hue](0.5 + 0.4 * (j + 1) / len(tasks))
        for hue, tasks in alike.items()
        for j, task in enumerate(tasks)
    }


def _whole(value: float, _position: int = 0) -> str:
    return f"{value:,.0f}"
