"""Rules of agents and points in the plane, as compiled loops that write into the arrays they are given.

Distances are Euclidean, m; worlds come first. Every rule goes world by world in the order as written.
"""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Bool, Float, Float32, Int32

from hipg_bench.mechanics.histogram import EDGES, RINGS, SECTORS
from hipg_bench.native import compiled

_FADE = 40.0
"""Margins beyond contact at which softplus is below 1e-17, and the push is left out."""
_CELLS = RINGS * SECTORS
_EDGE0, _EDGE1, _EDGE2, _EDGE3 = EDGES.tolist()
_SLOPE = math.tan(math.pi / 8)
"""Within half a sector of an axis, one coordinate is at most this share of the other."""
_KIND = _CELLS + SECTORS
"""Cells of a kind of things, with those beyond the last edge, which nobody reads."""
_AGENT, _POINT, _HIDDEN = range(0, 3 * _KIND, _KIND)
LISTED = 5
"""Dead agents that a look lists."""


@compiled
def square(a: Float[np.ndarray, "2"], b: Float[np.ndarray, "2"]) -> float:
    """Squared distance between two places."""
    x, y = b[0] - a[0], b[1] - a[1]
    return x * x + y * y


@compiled
def gap(a: Float[np.ndarray, "2"], b: Float[np.ndarray, "2"]) -> float:
    """Distance between two places."""
    return math.sqrt(square(a, b))


@compiled
def anyone_near(position: Float[np.ndarray, "N 2"], i: int, reach: float) -> bool:
    """Whether any agent of a higher number may be within reach, m: a first look, without branches."""
    count, limit = 0, reach * reach * (1 + 1e-9)
    for j in range(i + 1, len(position)):
        count += 1 if square(position[i], position[j]) < limit else 0
    return count > 0


@compiled
def push_apart(
    position: Float[np.ndarray, "B N 2"],
    solid: Bool[np.ndarray, "B N"],
    reach: float,
    stiffness: float,
    margin: float,
    force: Float[np.ndarray, "B N 2"],
) -> None:
    """Soft contact force on each agent: ``stiffness * margin * softplus((reach - d) / margin)``, N.

    Source: the particle environments' contact law (facts sheet, section 0, "contact"). Pairs that
    stand at the very same place push nowhere: they have no line of centres.

    Args:
        position: m.
        solid: agents that touch others at all.
        reach: sum of two radii, m.
        stiffness: N/m deep inside the contact.
        margin: depth over which the contact sets in, m.
        force: written into.
    """
    force[:] = 0.0
    worlds, agents, _ = position.shape
    far = reach + _FADE * margin
    for world in range(worlds):
        for i in range(agents):
            if not anyone_near(position[world], i, far):
                continue
            for j in range(i + 1, agents):
                distance = gap(position[world, i], position[world, j])
                if 0 < distance < far and solid[world, i] and solid[world, j]:
                    depth = (reach - distance) / margin
                    softplus = max(depth, 0.0) + math.log1p(math.exp(-abs(depth)))
                    for axis in range(2):
                        along = (position[world, j, axis] - position[world, i, axis]) / distance
                        push = along * (stiffness * margin * softplus)
                        force[world, i, axis] -= push
                        force[world, j, axis] += push


@compiled
def count_overlaps(
    position: Float[np.ndarray, "B N 2"],
    alive: Bool[np.ndarray, "B N"],
    reach: float,
    touching: Float[np.ndarray, "B N"],
    overlaps: Float[np.ndarray, "B 2"],
) -> None:
    """Count who is nearer to whom than ``reach`` m.

    Args:
        position: m.
        alive: who lives.
        reach: sum of two radii, m.
        touching: written into, for each live agent the other live ones that it touches.
        overlaps: written into, pairs that both live, and pairs of which one does.
    """
    touching[:] = 0.0
    overlaps[:] = 0.0
    worlds, agents, _ = position.shape
    for world in range(worlds):
        for i in range(agents):
            if not anyone_near(position[world], i, reach):
                continue
            for j in range(i + 1, agents):
                if gap(position[world, i], position[world, j]) < reach:
                    if alive[world, i] and alive[world, j]:
                        touching[world, i] += 1.0
                        touching[world, j] += 1.0
                        overlaps[world, 0] += 1.0
                    elif alive[world, i] or alive[world, j]:
                        overlaps[world, 1] += 1.0


@compiled
def find_links(
    position: Float[np.ndarray, "B N 2"],
    alive: Bool[np.ndarray, "B N"],
    end: Float[np.ndarray, "B 2 2"],
    reach: float,
    linked: Bool[np.ndarray, "B"],
) -> None:
    """Find out whether live agents, each within ``reach`` m of the next, link two ends.

    Args:
        position: m.
        alive: who relays.
        end: places that hear agents, but not each other, m.
        reach: of the radio, m.
        linked: written into.
    """
    worlds, agents, _ = position.shape
    reached, relay = np.empty(agents, np.bool_), np.empty(agents, np.int64)
    for world in range(worlds):
        linked[world] = False
        count = 0  # of those reached, in the order in which they were
        for i in range(agents):
            reached[i] = alive[world, i] and gap(position[world, i], end[world, 0]) <= reach
            if reached[i]:
                relay[count] = i
                count += 1
        spread = 0  # of them have passed it on
        while spread < count and not linked[world]:
            here = position[world, relay[spread]]
            spread += 1
            linked[world] = gap(here, end[world, 1]) <= reach
            for j in range(agents):
                if alive[world, j] and not reached[j] and gap(here, position[world, j]) <= reach:
                    reached[j] = True
                    relay[count] = j
                    count += 1


@compiled
def find_within(
    position: Float[np.ndarray, "B N 2"],
    point: Float[np.ndarray, "B L 2"],
    counts: Bool[np.ndarray, "B L"],
    radius: float,
    within: Bool[np.ndarray, "B N L"],
) -> None:
    """Find the agents that are nearer than ``radius`` m to points that count.

    Args:
        position: of the agents, m.
        point: m.
        counts: which points do.
        radius: m.
        within: written into.
    """
    within[:] = False
    worlds, agents, _ = position.shape
    for world in range(worlds):
        for k in range(point.shape[1]):
            if counts[world, k]:
                for i in range(agents):
                    within[world, i, k] = gap(position[world, i], point[world, k]) < radius


@compiled
def sum_gaps(
    position: Float[np.ndarray, "B N 2"],
    covers: Bool[np.ndarray, "B N"],
    point: Float[np.ndarray, "B L 2"],
    counts: Bool[np.ndarray, "B L"],
    nobody: float,
    total: Float[np.ndarray, "B"],
) -> None:
    """Sum, over the points that count, the distance to the nearest agent that covers.

    Args:
        position: of the agents, m.
        covers: agents that cover points.
        point: m.
        counts: points that are summed over.
        nobody: distance that is charged for a point where no agent covers, m.
        total: written into, m.
    """
    total[:] = 0.0
    worlds, agents, _ = position.shape
    for world in range(worlds):
        for k in range(point.shape[1]):
            if counts[world, k]:
                nearest = math.inf
                for i in range(agents):
                    if covers[world, i]:
                        nearest = min(nearest, square(position[world, i], point[world, k]))
                total[world] += nobody if nearest == math.inf else math.sqrt(nearest)


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
    look: Float32[np.ndarray, "B N K"],
    both: Float32[np.ndarray, "B N 2*K"],
) -> None:
    """Look around, and put it before what was seen in the step before; the rows of the dead are zeros.

    A look begins with 0 (not dead), the agent's own velocity and position, and what all are told.

    Args:
        position: of the agents, m.
        velocity: m/s.
        dead: who neither sees nor is counted, but listed.
        point: places, m.
        shown: those that are counted.
        known: those of which the nearest is listed.
        told: numbers for all agents of a world.
        past: the looks of the step before.
        others: column of a look in which the histogram of the other live agents begins.
        points: the same for that of points; -1 where there is none.
        listed: the same for the nearest dead.
        hazard: the same for the nearest known point; -1 where there is none.
        look: written into.
        both: written into: looks, then past looks.
    """
    worlds, agents, _ = position.shape
    size, things = look.shape[2], agents + point.shape[1]
    x, y, count = np.empty(things), np.empty(things), np.empty(3 * _KIND, np.int32)
    kind, cell = np.empty(things, np.int32), np.empty(things, np.int32)
    for world in range(worlds):
        for i in range(agents):
            x[i], y[i] = position[world, i, 0], position[world, i, 1]
            kind[i] = _HIDDEN if dead[world, i] else _AGENT
        for i in range(agents, things):
            x[i], y[i] = point[world, i - agents, 0], point[world, i - agents, 1]
            kind[i] = _POINT if shown[world, i - agents] else _HIDDEN
        deaths, knowledge = dead[world].any(), known[world].any()
        for i in range(agents):
            row = look[world, i]
            if dead[world, i]:
                row[:] = 0.0
                both[world, i] = 0.0
                continue
            row[0] = 0.0
            for axis in range(2):
                row[1 + axis], row[3 + axis] = velocity[world, i, axis], position[world, i, axis]
            for k in range(told.shape[1]):
                row[5 + k] = told[world, k]
            count_around(i, x, y, kind, cell, count)
            for k in range(_CELLS):
                row[others + k] = count[_AGENT + k]
            if points >= 0:
                for k in range(_CELLS):
                    row[points + k] = count[_POINT + k]
            for k in range(2 * LISTED):
                row[listed + k] = 0.0
            if deaths:
                list_nearest(position[world, i], position[world], dead[world], row[listed:], LISTED)
            if hazard >= 0:
                row[hazard] = row[hazard + 1] = 0.0
                if knowledge:
                    list_nearest(position[world, i], point[world], known[world], row[hazard:], 1)
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
def list_nearest(
    here: Float[np.ndarray, "2"],
    thing: Float[np.ndarray, "M 2"],
    counts: Bool[np.ndarray, "M"],
    row: Float32[np.ndarray, "K"],
    slots: int,
) -> None:
    """Write where the nearest things lie from here, nearest first; what is left empty stays as it is.

    Args:
        here: m.
        thing: m. Things as far as each other go by number.
        counts: which things do.
        row: written into, from its beginning.
        slots: how many things at most.
    """
    last, far = -1, -1.0  # what was listed last, and its squared distance
    for slot in range(slots):
        which, nearest = -1, math.inf
        for k in range(len(counts)):
            if counts[k]:
                away = square(here, thing[k])
                if (away > far or (away == far and k > last)) and away < nearest:
                    which, nearest = k, away
        if which < 0:
            break
        last, far = which, nearest
        for axis in range(2):
            row[2 * slot + axis] = thing[which, axis] - here[axis]
