"""Rules of agents and points in the plane, as compiled loops that write into the arrays they are given.

Distances are Euclidean, m; worlds come first. Every rule goes world by world in the order as written.
"""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Bool, Float, Int

from hipg_bench.native import compiled

_FADE = 40.0
"""Margins beyond contact at which softplus is below 1e-17, and the push is left out."""
_SIDE_BY_SIDE = 16
"""Worlds of which a processor works out the same pair at once."""


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
def read(
    worlds: Int[np.ndarray, "n"],
    coordinate: Float[np.ndarray, "B C"],
    rate: Float[np.ndarray, "B C"],
    health: Float[np.ndarray, "B N"],
    kept: Float[np.ndarray, "B C"],
    marker: Float[np.ndarray, "B L 3"],
    position: Float[np.ndarray, "n N 2"],
    velocity: Float[np.ndarray, "n N 2"],
    point: Float[np.ndarray, "n L 2"],
) -> None:
    """Read where agents and points are, and how agents move.

    Args:
        worlds: which to read.
        coordinate: of the agents, m.
        rate: of the coordinates, m/s.
        health: 0 of the dead, who are seen with the velocity that they died with.
        kept: that velocity, m/s.
        marker: points in space, m.
        position: written into, m.
        velocity: written into, m/s.
        point: written into, m.
    """
    for k in range(len(worlds)):
        world = worlds[k]
        for i in range(position.shape[1]):
            for axis in range(2):
                moves = rate[world, 2 * i + axis] if health[world, i] != 0 else kept[world, 2 * i + axis]
                position[k, i, axis], velocity[k, i, axis] = coordinate[world, 2 * i + axis], moves
        for i in range(point.shape[1]):
            for axis in range(2):
                point[k, i, axis] = marker[world, i, axis]


@compiled
def find_closest(position: Float[np.ndarray, "B N 2"], closest: Float[np.ndarray, "B"]) -> None:
    """Find the squared distance of the two agents that are closest, worlds side by side.

    Args:
        position: m.
        closest: written into, m^2; infinite with one agent only.
    """
    worlds, agents, _ = position.shape
    x, least = np.zeros((agents, _SIDE_BY_SIDE)), np.empty(_SIDE_BY_SIDE)
    y = np.zeros_like(x)
    for first in range(0, worlds, _SIDE_BY_SIDE):
        some = min(_SIDE_BY_SIDE, worlds - first)
        for world in range(some):
            for i in range(agents):
                x[i, world], y[i, world] = position[first + world, i, 0], position[first + world, i, 1]
        least[:] = math.inf
        for i in range(agents):
            for j in range(i + 1, agents):
                for world in range(_SIDE_BY_SIDE):
                    east, north = x[j, world] - x[i, world], y[j, world] - y[i, world]
                    away = east * east + north * north
                    least[world] = away if away < least[world] else least[world]
        for world in range(some):
            closest[first + world] = least[world]


@compiled
def may_be_within(squared: float, reach: float) -> bool:
    """Whether a squared distance, whatever its last bits, allows for a distance below ``reach`` m."""
    return squared < reach * reach * (1 + 1e-9)


@compiled
def push_apart(
    position: Float[np.ndarray, "B N 2"],
    closest: Float[np.ndarray, "B"],
    solid: Bool[np.ndarray, "B N"],
    reach: float,
    stiffness: float,
    margin: float,
    scale: float,
    force: Float[np.ndarray, "B C"],
) -> None:
    """Soft contact force on each agent: ``stiffness * margin * softplus((reach - d) / margin)``, N.

    Source: the particle environments' contact law (facts sheet, section 0, "contact"). Pairs that
    stand at the very same place push nowhere: they have no line of centres.

    Args:
        position: m.
        closest: as `find_closest` says.
        solid: agents that touch others at all.
        reach: sum of two radii, m.
        stiffness: N/m deep inside the contact.
        margin: depth over which the contact sets in, m.
        scale: by which the sum over an agent's contacts is multiplied.
        force: written into, along the coordinates of one agent after another.
    """
    force[:] = 0.0
    worlds, agents, _ = position.shape
    far = reach + _FADE * margin
    for world in range(worlds):
        if not may_be_within(closest[world], far):
            continue
        for i in range(agents):
            for j in range(i + 1, agents):
                if not may_be_within(square(position[world, i], position[world, j]), far):
                    continue
                distance = gap(position[world, i], position[world, j])
                if 0 < distance < far and solid[world, i] and solid[world, j]:
                    depth = (reach - distance) / margin
                    softplus = max(depth, 0.0) + math.log1p(math.exp(-abs(depth)))
                    for axis in range(2):
                        along = (position[world, j, axis] - position[world, i, axis]) / distance
                        push = along * (stiffness * margin * softplus)
                        force[world, 2 * i + axis] -= push
                        force[world, 2 * j + axis] += push
        for k in range(2 * agents):
            force[world, k] *= scale


@compiled
def count_overlaps(
    position: Float[np.ndarray, "B N 2"],
    closest: Float[np.ndarray, "B"],
    alive: Bool[np.ndarray, "B N"],
    reach: float,
    touching: Float[np.ndarray, "B N"],
    overlaps: Float[np.ndarray, "B 2"],
) -> None:
    """Count who is nearer to whom than ``reach`` m.

    Args:
        position: m.
        closest: as `find_closest` says.
        alive: who lives.
        reach: sum of two radii, m.
        touching: written into, for each live agent the other live ones that it touches.
        overlaps: written into, pairs that both live, and pairs of which one does.
    """
    touching[:] = 0.0
    overlaps[:] = 0.0
    worlds, agents, _ = position.shape
    for world in range(worlds):
        if not may_be_within(closest[world], reach):
            continue
        for i in range(agents):
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
