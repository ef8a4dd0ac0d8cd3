"""What the paper's particles perceive: others listed, or counted in a view of one size for any team."""

from __future__ import annotations

from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Complex, Float, Float32, Shaped

from hipg_bench.layout import SHARE, Block, Layout
from hipg_bench.mechanics import histogram, looks
from hipg_bench.native import on_threads

CELLS = (histogram.RINGS, histogram.SECTORS)
IN_RANGE = f"within {histogram.EDGES[-1]:g} m"


@runtime_checkable
class Body(Protocol):
    """What a snapshot holds of a control step."""

    position: Float[np.ndarray, "B N 2"]
    velocity: Float[np.ndarray, "B N 2"]
    health: Float[np.ndarray, "B N"]
    point: Float[np.ndarray, "B L 2"]


def own_blocks() -> tuple[Block, ...]:
    """What every observation begins with."""
    return (
        Block("terminated", (1,), "1", "-", "1 once dead", limits=SHARE),
        Block("velocity", (2,), "m/s", "world"),
        Block("position", (2,), "m", "world"),
    )


def around_blocks() -> tuple[Block, ...]:
    """What every histogram observation ends with, per step."""
    return (
        Block("other_count", CELLS, "agents", "own", f"{IN_RANGE}, live agents"),
        Block("dead_position", (looks.LISTED, 2), "m", "own", "nearest dead agents, at any distance"),
    )


def two_steps(look: Layout) -> Layout:
    """A histogram observation: this control step, then the previous one."""
    before = tuple(
        Block(f"previous_{b.name}", b.shape, b.unit, b.frame, f"{b.visible}; one step ago, 0 at first")
        for b in look.blocks
    )
    return Layout((*look.blocks, *before))


class Hints(NamedTuple):
    """What a family adds to what agents see of each other."""

    told: Float[np.ndarray, "B T"]
    """Numbers that every agent is told of its world."""
    shown: Bool[np.ndarray, "B L"]
    """Points that are counted."""
    known: Bool[np.ndarray, "B L"]
    """Points of which the nearest is listed."""


def look(
    layout: Layout,
    now: Body,
    hints: Hints,
    dead_look: int,
    past: Float32[np.ndarray, "B N K"],
    threads: int,
) -> tuple[Float32[np.ndarray, "B N K"], Float32[np.ndarray, "B N 2*K"]]:
    """One control step's part of the histogram observation, and the whole of it.

    Args:
        layout: of one step's part.
        now: the control step.
        hints: what is told and shown.
        dead_look: what the dead see, see `hipg_bench.mechanics.looks.see`.
        past: the previous step's part.
        threads: how many to use.
    """
    start = {name: columns.start for name, columns in layout.slices.items()}
    points, hazard = start.get("point_count", -1), start.get("hazard_position", -1)
    dead, seen = now.health == 0, np.empty(past.shape, np.float32)
    both = np.empty((*dead.shape, 2 * layout.size), np.float32)

    def see(part: slice) -> None:
        looks.see(
            now.position[part], now.velocity[part], dead[part], now.point[part], hints.shown[part],
            hints.known[part], hints.told[part], past[part],
            start["other_count"], points, start["dead_position"], hazard, dead_look, seen[part], both[part],
        )  # fmt: skip

    on_threads(see, len(dead), threads)
    return seen, both


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
