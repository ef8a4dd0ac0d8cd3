"""Who watches which point, and who bumps into whom.

Arrays run along the worlds, B last, so that each operation sweeps over all worlds in one go; that is
several times faster than with short last axes.
"""

from __future__ import annotations

import functools

import numpy as np
from jaxtyping import Bool, Float, Int

from hipg_bench.mechanics.few import few


@functools.cache
def members(num_agents: int) -> tuple[Int[np.ndarray, "P"], Int[np.ndarray, "P"]]:
    """First and second agent of every pair."""
    return np.triu_indices(num_agents, 1)


def distances(a: Float[np.ndarray, "D P B"], b: Float[np.ndarray, "D Q B"]) -> Float[np.ndarray, "P Q B"]:
    """Euclidean distance between every point of ``a`` and every point of ``b``."""
    return _length(a[:, :, None] - b[:, None])


def apart(position: Float[np.ndarray, "D N B"]) -> Float[np.ndarray, "N N B"]:
    """Distance between every two agents; infinite from an agent to itself, lest it be its own neighbour."""
    _, agents, worlds = position.shape
    one, other = members(agents)
    distance = np.full((agents, agents, worlds), np.inf)
    distance[one, other] = distance[other, one] = _length(
        position.take(one, axis=1) - position.take(other, axis=1)
    )
    return distance


def nearest(
    distance: Float[np.ndarray, "N P B"], counts: Bool[np.ndarray, "N B"], nobody: float
) -> Float[np.ndarray, "P B"]:
    """Distance from each point to the nearest agent that counts.

    Args:
        distance: from agents to points, m.
        counts: the agents that can cover a point (usually the living).
        nobody: the distance that stands when no agent counts, and the most that is ever returned, m.
    """
    barrier = np.where(counts, 0.0, np.inf)
    return np.minimum.reduce(distance + barrier[:, None], axis=0, initial=nobody)


def contacts(
    apart: Float[np.ndarray, "N N B"], counts: Bool[np.ndarray, "N B"], reach: float
) -> Float[np.ndarray, "B"]:
    """Pairs of agents that count and are nearer than ``reach`` m; ``apart`` is infinite to oneself."""
    one, other, world = few(apart < reach)
    both = counts[one, world] & counts[other, world]
    return np.bincount(world[both], minlength=apart.shape[2]) / 2


def _length(gap: Float[np.ndarray, "D *pairs B"]) -> Float[np.ndarray, "*pairs B"]:
    """Length of each gap; overwrites them."""
    gap *= gap
    total, *others = gap
    # one after another: NumPy may pair the summands of a sum by the number of worlds
    for square in others:
        total += square
    return np.sqrt(total, out=total)
