"""What drones perceive of the things around them, as compiled loops that write observations.

Tables have the worlds last, observations have them first. What falls into a drone's slots is nearest first,
and things as far as each other go by number; empty slots hold zeros.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Float32, Int, Int8

from hipg_bench.native import compiled


@compiled
def write_own(
    first: int,
    last: int,
    health: Float[np.ndarray, "B N"],
    velocity: Float[np.ndarray, "3 N B"],
    position: Float[np.ndarray, "3 N B"],
    out: Float32[np.ndarray, "B N O"],
) -> None:
    """Write each drone's own health, velocity and position, with which its observation begins."""
    for world in range(first, last):
        for i in range(health.shape[1]):
            out[world, i, 0] = health[world, i]
            for axis in range(3):
                out[world, i, 1 + axis] = velocity[axis, i, world]
                out[world, i, 4 + axis] = position[axis, i, world]


@compiled
def write_team(
    first: int,
    last: int,
    apart: Float[np.ndarray, "N N B"],
    radius: float,
    health: Float[np.ndarray, "B N"],
    velocity: Float[np.ndarray, "3 N B"],
    position: Float[np.ndarray, "3 N B"],
    out: Float32[np.ndarray, "B N O"],
    column: int,
    slots: int,
    wrecks: int,
) -> None:
    """Write the nearest other drones within a radius, each kind into slots of its own.

    Args:
        first: world to begin with.
        last: world to end before.
        apart: between drones, infinite to oneself, m.
        radius: sensing radius, m.
        health: in [0, 1].
        velocity: m/s.
        position: m.
        out: written into: for the neighbours who is there, health, relative position and velocity; then
            for the wrecks who is there and relative position.
        column: where that begins.
        slots: how many neighbours at most.
        wrecks: how many of the dead at most; where it is 0, the dead are neighbours like the others.
    """
    agents = health.shape[1]
    nearest, distance = np.empty(agents, np.int64), np.empty(agents)
    places = column + 2 * slots
    speeds, seen_wrecks = places + 3 * slots, column + 8 * slots
    for world in range(first, last):
        for i in range(agents):
            row = out[world, i]
            row[column : seen_wrecks + 4 * wrecks] = 0.0
            count = rank_within(apart[i, :, world], radius, nearest, distance)
            near, lost = 0, 0
            for j in nearest[:count]:
                if wrecks and health[world, j] == 0:
                    if lost < wrecks:
                        row[seen_wrecks + lost] = 1.0
                        for axis in range(3):
                            gap = position[axis, j, world] - position[axis, i, world]
                            row[seen_wrecks + wrecks + 3 * lost + axis] = gap
                        lost += 1
                elif near < slots:
                    row[column + near] = 1.0
                    row[column + slots + near] = health[world, j]
                    for axis in range(3):
                        gap = position[axis, j, world] - position[axis, i, world]
                        row[places + 3 * near + axis] = gap
                        row[speeds + 3 * near + axis] = velocity[axis, j, world] - velocity[axis, i, world]
                    near += 1


@compiled
def write_points(
    first: int,
    last: int,
    away: Float[np.ndarray, "N P B"],
    apart: Float[np.ndarray, "N N B"],
    radius: float,
    health: Float[np.ndarray, "B N"],
    position: Float[np.ndarray, "3 N B"],
    point: Float[np.ndarray, "3 P B"],
    revealed: Bool[np.ndarray, "P B"],
    out: Float32[np.ndarray, "B N O"],
    column: int,
) -> None:
    """Write all points, nearest first: where they are, whether they are known to kill, and who is there.

    Args:
        first: world to begin with.
        last: world to end before.
        away: from drones to points, m.
        apart: between drones, infinite to oneself, m.
        radius: sensing radius, m.
        health: of the drones.
        position: of the drones, m.
        point: m.
        revealed: points that are known to kill.
        out: written into: relative positions; whether revealed; distance to the nearest other live drone
            that is sensed, at most the radius, m.
        column: where that begins.
    """
    agents, points, _ = away.shape
    order, distance, taken = np.empty(points, np.int64), np.empty(points), np.empty(points)
    for world in range(first, last):
        for i in range(agents):
            rank_within(away[i, :, world], np.inf, order, distance)
            taken[:] = radius
            for j in range(agents):
                if apart[i, j, world] <= radius and health[world, j] > 0:
                    for k in range(points):
                        taken[k] = min(taken[k], away[j, k, world])
            row = out[world, i]
            for k in range(points):
                which = order[k]
                for axis in range(3):
                    row[column + 3 * k + axis] = point[axis, which, world] - position[axis, i, world]
                row[column + 3 * points + k] = revealed[which, world]
                row[column + 4 * points + k] = taken[which]


@compiled
def write_routes(
    first: int,
    last: int,
    terminal: Float[np.ndarray, "3 2 B"],
    hops: Int8[np.ndarray, "2 N+2 B"],
    position: Float[np.ndarray, "3 N B"],
    out: Float32[np.ndarray, "B N O"],
    column: int,
) -> None:
    """Write where both terminals are, relative to each drone, then whether messages get there."""
    for world in range(first, last):
        for i in range(position.shape[1]):
            for k in range(2):
                for axis in range(3):
                    gap = terminal[axis, k, world] - position[axis, i, world]
                    out[world, i, column + 3 * k + axis] = gap
                out[world, i, column + 6 + k] = hops[k, 2 + i, world] >= 0


@compiled
def rank_within(
    away: Float[np.ndarray, "M"],
    radius: float,
    order: Int[np.ndarray, "M"],
    distance: Float[np.ndarray, "M"],
) -> int:
    """Write which things lie within a radius, nearest first, and how far away; return how many."""
    count = 0
    for k in range(len(away)):
        if away[k] <= radius:
            place = count
            while place > 0 and away[k] < distance[place - 1]:
                order[place], distance[place] = order[place - 1], distance[place - 1]
                place -= 1
            order[place], distance[place] = k, away[k]
            count += 1
    return count
