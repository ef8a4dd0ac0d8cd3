"""What the paper's particles perceive: others listed, or counted in a view of one size for any team."""

from __future__ import annotations

import functools
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Complex, Float, Float32, Int, Shaped

from hipg_bench.layout import Block, Layout
from hipg_bench.mechanics import histogram, pairs
from hipg_bench.mechanics.pairs import Gaps

LISTED = 5
"""Dead agents that the histogram observation lists."""
CELLS = (histogram.RINGS, histogram.SECTORS)
IN_RANGE = f"within {histogram.EDGES[-1]:g} m"


@runtime_checkable
class Body(Protocol):
    """What a snapshot holds of a control step."""

    position: Float[np.ndarray, "B N 2"]
    velocity: Float[np.ndarray, "B N 2"]
    health: Float[np.ndarray, "B N"]
    gaps: Gaps


def own_blocks() -> tuple[Block, ...]:
    """What every observation begins with."""
    return (
        Block("terminated", (1,), "1", "-", "1 once dead"),
        Block("velocity", (2,), "m/s", "world"),
        Block("position", (2,), "m", "world"),
    )


def around_blocks() -> tuple[Block, ...]:
    """What every histogram observation ends with, per step."""
    return (
        Block("other_count", CELLS, "agents", "own", f"{IN_RANGE}, live agents"),
        Block("dead_position", (LISTED, 2), "m", "own", "nearest dead agents, at any distance"),
    )


def two_steps(look: Layout) -> Layout:
    """A histogram observation: this control step, then the previous one."""
    before = tuple(
        Block(f"previous_{b.name}", b.shape, b.unit, b.frame, f"{b.visible}; one step ago, 0 at first")
        for b in look.blocks
    )
    return Layout((*look.blocks, *before))


def look(
    layout: Layout, now: Body, *, shown: Bool[np.ndarray, "B L"] | None = None, **more: np.ndarray
) -> Float32[np.ndarray, "B N K"]:
    """One control step's part of the histogram observation; what the dead would see means nothing.

    Args:
        layout: its blocks.
        now: the control step.
        shown: points that are counted, where points are.
        more: blocks of the family's own.
    """
    dead = now.health == 0
    record = np.zeros(dead.shape, layout.record)
    parts = {"terminated": dead[..., None], "velocity": now.velocity, "position": now.position, **more}
    for name, part in parts.items():
        record[name] = part
    if dead.any():
        _list_dead(record["dead_position"], now.position, dead)
    flat = record[..., None].view(np.float32)
    others = layout.slices["other_count"].start
    points = others if shown is None else layout.slices["point_count"].start
    _count(flat, now.gaps, ~dead, others, shown, points)
    return flat


def _count(
    look: Float32[np.ndarray, "B N K"],
    gaps: Gaps,
    alive: Bool[np.ndarray, "B N"],
    others: int,
    shown: Bool[np.ndarray, "B L"] | None,
    points: int,
) -> None:
    """Count into the histograms that begin in columns ``others`` and ``points`` of a look."""
    worlds, agents, size = look.shape
    count = 0 if shown is None else shown.shape[1]
    origin, mirrored = _origins(worlds, agents, count, size, others, points)
    counted = gaps.distance[: len(origin)] <= histogram.EDGES[-1]
    if not alive.all():
        one, other = pairs.of_both(alive)
        counted[: len(mirrored)] &= one & other
    if shown is not None and not shown.all():
        counted[len(mirrored) :] &= np.repeat(shown.T, agents, axis=0)
    (seen,) = counted.ravel().nonzero()
    x, y, distance = (part[: len(origin)].ravel().take(seen) for part in (*gaps.gap, gaps.distance))
    cell = histogram.cells(x, y, distance)
    flat, one_more = look.reshape(-1, copy=False), np.float32(1)
    np.add.at(flat, origin.take(seen) + cell, one_more)
    # of a pair, the second sees the first too
    mutual = np.searchsorted(seen, mirrored.size)
    np.add.at(flat, mirrored.take(seen[:mutual]) + histogram.opposite(cell[:mutual]), one_more)


@functools.lru_cache(maxsize=2)
def _origins(
    worlds: int, agents: int, count: int, size: int, others: int, points: int
) -> tuple[Int[np.ndarray, "K B"], Int[np.ndarray, "P B"]]:
    """Where in flat looks begins the histogram that a gap adds to; then the same for a pair's second."""
    first, second = pairs.members(agents)
    row = np.arange(worlds) * agents * size
    of_points = np.tile(np.arange(agents), count) * size + points
    origin = np.concatenate([first * size + others, of_points])
    return origin[:, None] + row, (second * size + others)[:, None] + row


def _list_dead(
    into: Float32[np.ndarray, "B N 5 2"], position: Float[np.ndarray, "B N 2"], dead: Bool[np.ndarray, "B N"]
) -> None:
    """Write where the nearest dead agents lie, seen from each live agent, m, at any distance."""
    place, deaths = _complex(position), dead.sum(axis=1)
    # worlds with as many dead at a time, so that nothing has to be left out
    for number in np.unique(deaths[deaths > 0]).tolist():
        ids = np.flatnonzero(deaths == number)
        which = dead[ids].nonzero()[1].reshape(-1, number)
        gap = place[ids[:, None], which][:, None] - place[ids][:, :, None]
        if number > 1:
            order = np.argsort(np.real(gap) ** 2 + np.imag(gap) ** 2, axis=-1, stable=True)[..., :LISTED]
            gap = np.take_along_axis(gap, order, axis=-1)
        into[ids, :, : gap.shape[-1]] = gap.view(np.float64).reshape(*gap.shape, 2)


def others(table: Shaped[np.ndarray, "*B N N"]) -> Shaped[np.ndarray, "*B N N-1"]:
    """Drop each agent's entry about itself."""
    n = table.shape[-1]
    # behind the first entry, every (N + 1)th lies on the diagonal
    rows = table.reshape(-1, n * n)[:, 1:].reshape(-1, n - 1, n + 1)[..., :-1]
    return rows.reshape(*table.shape[:-1], n - 1)


def relative(
    of: Float[np.ndarray, "B N 2"], shown: Bool[np.ndarray, "B N N-1"]
) -> Float[np.ndarray, "B N N-1 2"]:
    """A quantity of every other agent, in their order, less the observer's own; zeros where not shown."""
    vector = _complex(of)
    gap = np.where(shown, others(vector[:, None] - vector[:, :, None]), 0.0)
    return gap.view(np.float64).reshape(*gap.shape, 2)


def _complex(vector: Float[np.ndarray, "B N 2"]) -> Complex[np.ndarray, "B N"]:
    """Vectors of the plane as one number each, so that axes of two do not slow NumPy down."""
    return np.ascontiguousarray(vector).view(np.complex128)[..., 0]
