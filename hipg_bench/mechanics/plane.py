"""Agents and things in the plane: plain functions of one world. Distances are Euclidean, m."""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Bool, Float, Float32, Int, Int32

RINGS, SECTORS = 4, 8
EDGES = np.logspace(-1, 0, RINGS)
"""Outer edges of the rings, m: 0.1, 0.2154, 0.4642, 1. A thing on an edge is inside."""
EDGE0, EDGE1, EDGE2, EDGE3 = EDGES.tolist()
SLOPE = math.tan(math.pi / 8)
"""Within half a sector of an axis, one coordinate is at most this share of the other."""
CELLS = SECTORS * (RINGS + 1)
"""Cells of a kind of things, with those beyond the last edge, which nobody reads."""
FADE = 40.0
"""Margins beyond contact at which softplus is below 1e-17, and the push is left out."""


def length(x: float, y: float) -> float:
    """Length of a vector; not `math.hypot`, of which there are several."""
    return math.sqrt(x * x + y * y)


def push_apart(
    position: Float[np.ndarray, "N 2"],
    health: Float[np.ndarray, "N"],
    reach: float,
    stiffness: float,
    margin: float,
    scale: float,
    force: Float[np.ndarray, "N 2"],
) -> None:
    """Soft contact force on each live agent: ``stiffness * margin * softplus((reach - d) / margin)``, N.

    Source: the particle environments' contact law. Pairs that stand at the very same place push nowhere: they
    have no line of centres.

    Args:
        position: m.
        health: of the agents; the dead touch nobody.
        reach: sum of two radii, m.
        stiffness: N/m deep inside the contact.
        margin: depth over which the contact sets in, m.
        scale: by which the sum over an agent's contacts is multiplied.
        force: written into.
    """
    agents, far = len(position), reach + FADE * margin
    near = far * far * (1 + 1e-9)  # whatever the last bits of a squared distance are
    for i in range(agents):
        force[i, 0], force[i, 1] = 0.0, 0.0
    for i in range(agents):
        for j in range(i + 1, agents):
            x, y = position[j, 0] - position[i, 0], position[j, 1] - position[i, 1]
            if x * x + y * y >= near:
                continue
            distance = length(x, y)
            if 0 < distance < far and health[i] > 0 and health[j] > 0:
                depth = (reach - distance) / margin
                softplus = max(depth, 0.0) + math.log1p(math.exp(-abs(depth)))
                push = stiffness * margin * softplus
                force[i, 0] -= x / distance * push
                force[i, 1] -= y / distance * push
                force[j, 0] += x / distance * push
                force[j, 1] += y / distance * push
    for i in range(agents):
        force[i, 0], force[i, 1] = force[i, 0] * scale, force[i, 1] * scale


def find_contacts(position: Float[np.ndarray, "N 2"], reach: float, pair: Int[np.ndarray, "pairs 2"]) -> int:
    """Write the pairs of agents that are nearer to each other than ``reach`` m; return how many."""
    count, near = 0, reach * reach * (1 + 1e-9)
    for i in range(len(position)):
        for j in range(i + 1, len(position)):
            x, y = position[j, 0] - position[i, 0], position[j, 1] - position[i, 1]
            if x * x + y * y < near and length(x, y) < reach:
                pair[count, 0], pair[count, 1] = i, j
                count += 1
    return count


def is_linked(
    position: Float[np.ndarray, "N 2"],
    health: Float[np.ndarray, "N"],
    end: Float[np.ndarray, "L 3"],
    reach: float,
    reached: Bool[np.ndarray, "N"],
    queue: Int[np.ndarray, "N"],
) -> bool:
    """Whether live agents, each within ``reach`` m of the next, link places 0 and 1, which hear agents only.

    Args:
        position: of the agents, m.
        health: the dead do not relay.
        end: the places, m.
        reach: of the radio, m.
        reached: room to note who hears place 0.
        queue: room to note them in order.
    """
    agents, count, spread = len(position), 0, 0
    for i in range(agents):
        near = length(end[0, 0] - position[i, 0], end[0, 1] - position[i, 1]) <= reach
        reached[i] = near and health[i] > 0
        if reached[i]:
            queue[count] = i
            count += 1
    while spread < count:
        i = queue[spread]
        spread += 1
        if length(end[1, 0] - position[i, 0], end[1, 1] - position[i, 1]) <= reach:
            return True
        for j in range(agents):
            if health[j] > 0 and not reached[j]:
                near = length(position[j, 0] - position[i, 0], position[j, 1] - position[i, 1]) <= reach
                if near:
                    reached[j] = True
                    queue[count] = j
                    count += 1
    return False


def count_around(
    i: int,
    x: Float[np.ndarray, "M"],
    y: Float[np.ndarray, "M"],
    kind: Int32[np.ndarray, "M"],
    cell: Int32[np.ndarray, "M"],
    count: Int32[np.ndarray, "C"],
) -> None:
    """Count the things around thing ``i`` by kind, ring and sector: a view of one size for any team.

    Four rings out to 1 m, their edges evenly spaced in log distance, and eight sectors of 45 degrees centred
    on 0, 45, ... degrees from the x axis. Source: the authors' histogram observation. Nothing branches on
    where things are, which a processor would guess wrong about every second time.

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
        ring += 1 if distance > EDGE0 else 0
        ring += 1 if distance > EDGE1 else 0
        ring += 1 if distance > EDGE2 else 0
        ring += 1 if distance > EDGE3 else 0
        above = 3 if east < 0 else 1
        below = 5 if east < 0 else 7
        sector = below if north < 0 else above
        if high * SLOPE >= wide:
            sector = 6 if north < 0 else 2
        if wide * SLOPE >= high:
            sector = 4 if east < 0 else 0
        cell[j] = kind[j] + ring * SECTORS + sector
    for k in range(len(count)):
        count[k] = 0
    for j in range(len(kind)):
        count[cell[j]] += 1
    count[cell[i]] -= 1


def write_counts(count: Int32[np.ndarray, "C"], first: int, out: Float32[np.ndarray, "4 8"]) -> None:
    """Write the counts of the kind whose cells begin at ``first``, those beyond the last edge left out."""
    for ring in range(RINGS):
        for sector in range(SECTORS):
            out[ring, sector] = count[first + ring * SECTORS + sector]


def list_nearest(
    i: int,
    position: Float[np.ndarray, "N 2"],
    listed: Bool[np.ndarray, "N"],
    some: bool,
    out: Float32[np.ndarray, "slots 2"],
) -> None:
    """Write where the nearest listed agents lie from agent ``i``, nearest first, equally far ones by number.

    Args:
        i: the agent, which does not list itself.
        position: of all agents, m.
        listed: who may be listed.
        some: whether anybody is.
        out: written into; zeros where there are no more.
    """
    last, far = -1, -1.0  # who was listed last, and the squared distance
    for slot in range(len(out)):
        which, nearest = -1, math.inf
        if some and (slot == 0 or last >= 0):
            for k in range(len(position)):
                if listed[k] and k != i:
                    x, y = position[k, 0] - position[i, 0], position[k, 1] - position[i, 1]
                    away = x * x + y * y
                    if (away > far or (away == far and k > last)) and away < nearest:
                        which, nearest = k, away
        last, far = which, nearest
        for axis in range(2):
            out[slot, axis] = position[which, axis] - position[i, axis] if which >= 0 else 0.0
