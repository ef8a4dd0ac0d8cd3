"""Geometry of the page's charts, in SVG units from the top left; ``templates/charts.html.j2`` draws it.

Colours are classes (``c0`` .. ``c7``, ``reference``), so that both themes can say what they are.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Sequence

from matplotlib.ticker import MaxNLocator

_LABEL_GAP = 13.0
"""Between the labels of two lines' ends."""


@dataclasses.dataclass(frozen=True)
class Series:
    """A curve to draw.

    Attributes:
        label: what it is of.
        colour: a class of the style sheet.
        points: (x, y) in data units, x ascending.
        weights: of the points, 0 to 1, drawn as areas of dots; none, no dots.
        stairs: whether y holds until the next x.
    """

    label: str
    colour: str
    points: Sequence[tuple[float, float]]
    weights: Sequence[float] = ()
    stairs: bool = False


@dataclasses.dataclass(frozen=True)
class Tick:
    """A labelled place on an axis."""

    at: float
    label: str


@dataclasses.dataclass(frozen=True)
class Level:
    """A labelled horizontal line."""

    y: float
    label: str
    shift: float
    """Of its label below the line."""


@dataclasses.dataclass(frozen=True)
class Dot:
    """A point with an area, and what it says on hover."""

    x: float
    y: float
    r: float
    says: str


@dataclasses.dataclass(frozen=True)
class Curve:
    """A curve as it is drawn; ``end`` is where its label stands."""

    label: str
    colour: str
    path: str
    dots: Sequence[Dot]
    end: tuple[float, float]


@dataclasses.dataclass(frozen=True)
class Chart:
    """Curves over two axes."""

    width: float
    height: float
    left: float
    right: float
    top: float
    bottom: float
    x_ticks: Sequence[Tick]
    y_ticks: Sequence[Tick]
    curves: Sequence[Curve]
    levels: Sequence[Level]
    x_label: str
    y_label: str
    legend: bool


def chart(
    series: Sequence[Series],
    *,
    x_label: str,
    y_label: str,
    levels: Sequence[tuple[str, float]] = (),
    x_limits: tuple[float, float] | None = None,
    y_limits: tuple[float, float] | None = None,
    whole_x: bool = False,
    legend: bool = False,
    size: tuple[float, float] = (560.0, 300.0),
) -> Chart | None:
    """Lay out curves; None if there are none.

    Args:
        series: the curves.
        x_label: what the horizontal axis is of.
        y_label: what the vertical axis is of.
        levels: labels and heights of horizontal lines.
        x_limits: ends of the horizontal axis, by default those of the data.
        y_limits: ends of the vertical axis.
        whole_x: x counts something.
        legend: name the curves above the chart instead of at their ends.
        size: of the whole drawing.
    """
    points = [point for one in series for point in one.points]
    if not points:
        return None
    x_low, x_high = x_limits or _ends([x for x, _ in points], 0.04 if whole_x else 0.0)
    y_low, y_high = y_limits or _ends([y for _, y in points] + [y for _, y in levels], 0.08)
    width, height = size
    left, right, top, bottom = 46.0, width - (12.0 if legend else 128.0), 26.0, height - 40.0

    def x_at(value: float) -> float:
        return round(left + (right - left) * (value - x_low) / (x_high - x_low), 1)

    def y_at(value: float) -> float:
        return round(bottom - (bottom - top) * (value - y_low) / (y_high - y_low), 1)

    drawn = [
        Curve(
            one.label,
            one.colour,
            _path([(x_at(x), y_at(y)) for x, y in one.points], one.stairs),
            [
                Dot(
                    x_at(x),
                    y_at(y),
                    round(2.0 + 5.0 * weight**0.5, 1),
                    f"{one.label}: {y:.2f} at {x:g}, {weight:.0%}",
                )
                for (x, y), weight in zip(one.points, one.weights, strict=False)
            ],
            (x_at(one.points[-1][0]), y_at(one.points[-1][1])),
        )
        for one in series
        if one.points
    ]
    return Chart(
        width, height, left, right, top, bottom,
        [Tick(x_at(value), label) for value, label in ticks(x_low, x_high, whole=whole_x)],
        [Tick(y_at(value), label) for value, label in ticks(y_low, y_high)],
        _with_labels_apart(drawn, top, bottom), [Level(y_at(y), label, -5.0) for label, y in levels],
        x_label, y_label, legend,
    )  # fmt: skip


def ticks(low: float, high: float, *, whole: bool = False) -> list[tuple[float, str]]:
    """Round values between two others, with labels."""
    values = MaxNLocator(nbins=5, steps=[1, 2, 2.5, 5, 10], integer=whole).tick_values(low, high)
    inside = [float(value) for value in values if low - 1e-9 <= value <= high + 1e-9]
    return [(value, _say(value)) for value in inside]


def _say(value: float) -> str:
    value = value + 0.0 if abs(value) > 1e-12 else 0.0
    if abs(value) >= 1e6:
        return f"{value / 1e6:g}M".replace("-", "\u2212")
    if abs(value) >= 1e4:
        return f"{value / 1e3:g}k".replace("-", "\u2212")
    return f"{value:g}".replace("-", "\u2212")


def _ends(values: Iterable[float], margin: float) -> tuple[float, float]:
    found = list(values)
    low, high = min(found), max(found)
    room = margin * (high - low) or 0.5 * (low == high)
    return low - room, high + room


def _path(points: Sequence[tuple[float, float]], stairs: bool) -> str:
    """An SVG path through points."""
    (x, y), *others = points
    parts = [f"M{x:g} {y:g}"]
    for x, y in others:
        parts.append(f"H{x:g}V{y:g}" if stairs else f"L{x:g} {y:g}")
    return "".join(parts)


def _with_labels_apart(curves: Sequence[Curve], top: float, bottom: float) -> list[Curve]:
    """Move the labels of curves that end close together apart, in the order of their ends."""
    ordered = sorted(curves, key=lambda curve: curve.end[1])
    heights = [curve.end[1] for curve in ordered]
    for k in range(1, len(heights)):
        heights[k] = max(heights[k], heights[k - 1] + _LABEL_GAP)
    over = max(0.0, heights[-1] - bottom) if heights else 0.0
    if over:
        heights[-1] -= over
        for k in range(len(heights) - 2, -1, -1):
            heights[k] = max(top, min(heights[k], heights[k + 1] - _LABEL_GAP))
    return [
        dataclasses.replace(curve, end=(curve.end[0], round(height, 1)))
        for curve, height in zip(ordered, heights, strict=True)
    ]
