"""What agents perceive of the things around them: the nearest few, within a radius.

Arrays run along the worlds, B last, as in `hipg_bench.mechanics.coverage`. What fills a slot is told by
its place in a flat table of M things by B worlds, which is ``B * thing + world``.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, Int8, Shaped

_FRONT = np.iinfo(np.int64).min
"""The sign bit: a number that has it sorts before all that do not."""


class Sensed(NamedTuple):
    """The K other agents that fill each agent's slots, nearest first."""

    place: Int[np.ndarray, "K N B"]
    """Who fills the slot; of an empty slot, oneself, from whom nothing differs."""
    seen: Bool[np.ndarray, "K N B"]
    """Whether the slot is filled."""


def nearest(distance: Float[np.ndarray, "N M B"], slots: int) -> Int[np.ndarray, "K N B"]:
    """Fill each agent's slots with the places of the things nearest to it.

    Args:
        distance: from agents to things, m. Things as far as each other, to one part in 10^13, go by number.
        slots: K, at most M.
    """
    return _place(_ranking(distance, slots), distance.shape[2])


def nearest_within(distance: Float[np.ndarray, "N N B"], radius: float, slots: int) -> Sensed:
    """Fill each agent's slots with the nearest others within ``radius`` m.

    Args:
        distance: between agents, infinite to oneself and to those that cannot be sensed, m.
        radius: sensing radius, m.
        slots: K, at most N.
    """
    return _fill(_ranking(distance, slots), _count(distance <= radius))


def nearest_of_two_kinds(
    distance: Float[np.ndarray, "N N B"],
    first: Bool[np.ndarray, "N B"],
    radius: float,
    slots: tuple[int, int],
) -> tuple[Sensed, Sensed]:
    """Do as `nearest_within` for agents of two kinds, each with slots of its own, at the price of one sort.

    Args:
        distance: between agents, infinite to oneself, m.
        first: the agents of the first kind.
        radius: sensing radius, m.
        slots: for the first kind and for the rest, each at most N.
    """
    things, agents, worlds = distance.shape
    ranking = _ranking(distance, things, first)
    near = distance <= radius
    count = _count(near & first)
    # the rest begin where the first kind ends
    rank = np.minimum(np.arange(slots[1])[:, None] + first.sum(axis=0), things - 1)
    row = np.arange(agents * worlds).reshape(agents, worlds)
    rest = ranking.reshape(-1).take(rank[:, None] * (agents * worlds) + row)
    return _fill(ranking[: slots[0]], count), _fill(rest, _count(near) - count)


def look_up(
    table: Shaped[np.ndarray, "C M B"], place: Int[np.ndarray, "K N B"]
) -> Shaped[np.ndarray, "C K N B"]:
    """Look up what fills the slots in a table of C numbers for each thing."""
    return table.reshape(len(table), -1).take(place, axis=1)


def look_up_own(
    table: Shaped[np.ndarray, "N M B"], place: Int[np.ndarray, "K N B"]
) -> Shaped[np.ndarray, "K N B"]:
    """Look up what fills the slots in each agent's own table, of one number for each thing."""
    start = np.arange(0, table.size, table[0].size)
    return table.reshape(-1).take(place + start[:, None])


def _ranking(
    distance: Float[np.ndarray, "N M B"], slots: int, first: Bool[np.ndarray, "M B"] | None = None
) -> Int8[np.ndarray, "K N B"]:
    """Numbers of the nearest things, nearest first, those of the ``first`` kind before all others.

    Read as integers, the bits of distances sort as these do. The lowest bits give way to the number of the
    thing, so that one plain sort, several times faster than a stable argsort, tells the order.
    """
    agents, things, worlds = distance.shape
    low = (1 << (things - 1).bit_length()) - 1
    row = np.empty((worlds, agents, things))
    # one agent at a time: turned all at once, numbers a power of two apart evict each other from the cache
    for i in range(agents):
        row[:, i] = distance[i].T
    key = row.view(np.int64)
    key &= ~low
    key |= np.arange(things) if first is None else np.arange(things) + (first * _FRONT).T[:, None]
    key.sort(axis=-1)
    return np.ascontiguousarray((key[..., :slots].astype(np.int8) & low).T)


def _count(near: Bool[np.ndarray, "N M B"]) -> Int8[np.ndarray, "N B"]:
    """How many things are near each agent."""
    return np.add.reduce(near, axis=1, dtype=np.int8)


def _fill(which: Int8[np.ndarray, "K N B"], count: Int8[np.ndarray, "N B"]) -> Sensed:
    """Fill the first ``count`` slots of each agent, and the others with itself."""
    slots, agents, worlds = which.shape
    seen = np.arange(slots, dtype=np.int8)[:, None, None] < count
    return Sensed(_place(np.where(seen, which, np.arange(agents, dtype=np.int8)[:, None]), worlds), seen)


def _place(which: Int8[np.ndarray, "K N B"], worlds: int) -> Int[np.ndarray, "K N B"]:
    """Where the things stand in a flat table."""
    place = np.multiply(which, worlds, dtype=np.int64)
    place += np.arange(worlds)
    return place
