"""What agents in the plane see around them, as compiled loops that write into the arrays they are given.

Distances are Euclidean, m; worlds come first. Memory is what costs most: a look is worked out and written
before the next one begins.
"""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Bool, Float, Float32, Int32

from hipg_bench.mechanics.histogram import EDGES, RINGS, SECTORS
from hipg_bench.native import compiled

LISTED = 5
"""Dead agents that a look lists."""
NOTHING, NO_AGENTS, ALL = range(3)
"""What the dead see."""
_CELLS = RINGS * SECTORS
_EDGE0, _EDGE1, _EDGE2, _EDGE3 = EDGES.tolist()
_SLOPE = math.tan(math.pi / 8)
"""Within half a sector of an axis, one coordinate is at most this share of the other."""
_KIND = _CELLS + SECTORS
"""Cells of a kind of things, with those beyond the last edge, which nobody reads."""
_AGENT, _POINT, _HIDDEN = range(0, 3 * _KIND, _KIND)


@compiled
def see(
    position: Float[np.ndarray, "B N 2"],
    velocity: Float[np.ndarray, "B N 2"],
    dead: Bool[np.ndarray, "B N"],
    point: Float[np.ndarray, "B L 2"],
    shown: Bool[np.ndarray, "B L"],
    known: Bool[np.ndarray, "B L"],
    told: Float[np.ndarray, "B T"],
    past: Float32[np.ndarray, "B N K"],
    others: int,
    points: int,
    listed: int,
    hazard: int,
    dead_look: int,
    look: Float32[np.ndarray, "B N K"],
    both: Float32[np.ndarray, "B N 2*K"],
) -> None:
    """Look around, and put it before what was seen in the step before.

    A look begins with whether the agent is dead, its velocity and position, and what all are told.

    Args:
        position: of the agents, m.
        velocity: m/s.
        dead: who is not counted, but listed.
        point: places, m.
        shown: those that are counted.
        known: those of which the nearest is listed.
        told: numbers for all agents of a world.
        past: the looks of the step before.
        others: column of a look in which the histogram of the other live agents begins.
        points: the same for that of points; -1 where there is none.
        listed: the same for the nearest dead.
        hazard: the same for the nearest known point; -1 where there is none.
        dead_look: what the dead see: `NOTHING`, zeros; `NO_AGENTS`, all but the histogram of other agents;
            `ALL`, what the living see. No agent lists itself.
        look: written into.
        both: written into: looks, then past looks.
    """
    worlds, agents, _ = position.shape
    size, things = look.shape[2], agents + (point.shape[1] if points >= 0 else 0)
    x, y, count = np.empty(things), np.empty(things), np.empty(3 * _KIND, np.int32)
    kind, cell = np.empty(things, np.int32), np.empty(things, np.int32)
    for world in range(worlds):
        for i in range(agents):
            x[i], y[i] = position[world, i, 0], position[world, i, 1]
            kind[i] = _HIDDEN if dead[world, i] else _AGENT
        for i in range(agents, things):
            x[i], y[i] = point[world, i - agents, 0], point[world, i - agents, 1]
            kind[i] = _POINT if shown[world, i - agents] else _HIDDEN
        deaths, knowledge = how_many(world, dead), how_many(world, known)
        for i in range(agents):
            row = look[world, i]
            if dead[world, i] and dead_look == NOTHING:
                row[:] = 0.0
                both[world, i] = 0.0
                continue
            row[0] = 1.0 if dead[world, i] else 0.0
            for axis in range(2):
                row[1 + axis], row[3 + axis] = velocity[world, i, axis], position[world, i, axis]
            for k in range(told.shape[1]):
                row[5 + k] = told[world, k]
            count_around(i, x, y, kind, cell, count)
            cells = row[others : others + _CELLS]
            for k in range(len(cells)):
                cells[k] = 0 if dead[world, i] and dead_look == NO_AGENTS else count[_AGENT + k]
            if points >= 0:
                cells = row[points : points + _CELLS]
                for k in range(len(cells)):
                    cells[k] = count[_POINT + k]
            for k in range(2 * LISTED):
                row[listed + k] = 0.0
            if deaths:
                list_nearest(world, i, position, position, dead, i, LISTED, listed, look)
            if hazard >= 0:
                row[hazard] = row[hazard + 1] = 0.0
                if knowledge:
                    list_nearest(world, i, position, point, known, -1, 1, hazard, look)
            for k in range(size):
                both[world, i, k] = row[k]
            for k in range(size):
                both[world, i, size + k] = past[world, i, k]


@compiled
def count_around(
    i: int,
    x: Float[np.ndarray, "M"],
    y: Float[np.ndarray, "M"],
    kind: Int32[np.ndarray, "M"],
    cell: Int32[np.ndarray, "M"],
    count: Int32[np.ndarray, "C"],
) -> None:
    """Count the things around thing ``i`` by kind, ring and sector.

    Nothing branches on where things are, which a processor would guess wrong about every second time.

    Args:
        i: whose surroundings.
        x: of all things, m.
        y: m.
        kind: where in ``count`` the cells of its kind begin.
        cell: room to note the cell of each thing.
        count: written into.
    """
    for j in range(len(kind)):
        east, north = x[j] - x[i], y[j] - y[i]
        wide, high = abs(east), abs(north)
        distance = math.sqrt(east * east + north * north)
        ring = 0
        ring += 1 if distance > _EDGE0 else 0
        ring += 1 if distance > _EDGE1 else 0
        ring += 1 if distance > _EDGE2 else 0
        ring += 1 if distance > _EDGE3 else 0
        above = 3 if east < 0 else 1
        below = 5 if east < 0 else 7
        sector = below if north < 0 else above
        if high * _SLOPE >= wide:
            sector = 6 if north < 0 else 2
        if wide * _SLOPE >= high:
            sector = 4 if east < 0 else 0
        cell[j] = kind[j] + ring * SECTORS + sector
    count[:] = 0
    for j in range(len(kind)):
        count[cell[j]] += 1
    count[cell[i]] -= 1


@compiled
def how_many(world: int, holds: Bool[np.ndarray, "B M"]) -> int:
    """Count where it holds in a world."""
    count = 0
    for k in range(holds.shape[1]):
        count += 1 if holds[world, k] else 0
    return count


@compiled
def list_nearest(
    world: int,
    i: int,
    position: Float[np.ndarray, "B N 2"],
    thing: Float[np.ndarray, "B M 2"],
    counts: Bool[np.ndarray, "B M"],
    itself: int,
    slots: int,
    column: int,
    seen: Float32[np.ndarray, "B N O"],
) -> None:
    """Write where the nearest things lie from an agent, nearest first; what is left stays as it is.

    Args:
        world: of agent and things.
        i: the agent.
        position: of the agents, m.
        thing: m. Things as far as each other go by number.
        counts: which things do.
        itself: the thing that is the agent, which is left out; -1 where none is.
        slots: how many things at most.
        column: of the first.
        seen: written into.
    """
    last, far = -1, -1.0  # what was listed last, and its squared distance
    for slot in range(min(slots, how_many(world, counts))):
        which, nearest = -1, math.inf
        for k in range(thing.shape[1]):
            if counts[world, k] and k != itself:
                x = thing[world, k, 0] - position[world, i, 0]
                y = thing[world, k, 1] - position[world, i, 1]
                away = x * x + y * y
                if (away > far or (away == far and k > last)) and away < nearest:
                    which, nearest = k, away
        if which < 0:
            break
        last, far = which, nearest
        for axis in range(2):
            seen[world, i, column + 2 * slot + axis] = thing[world, which, axis] - position[world, i, axis]
