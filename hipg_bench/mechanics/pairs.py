"""Gaps in the plane: between all agents, and from agents to points.

Arrays run along the worlds, B last, so that each operation sweeps over all worlds in one go; that is
several times faster than with short last axes. N agents make P = N (N - 1) / 2 pairs, each of them
once, in the order (0, 1), (0, 2), ..., (N - 2, N - 1).
"""

from __future__ import annotations

import functools
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

_FADE = 40.0
"""Margins beyond contact at which softplus is below 1e-17, and the push is left out."""


class Gaps(NamedTuple):
    """How things stand to each other: P pairs of agents, or L points by N agents."""

    gap: Float[np.ndarray, "2 *pairs B"]
    """From the first agent to the second, or from the agent to the point, m."""
    distance: Float[np.ndarray, "*pairs B"]
    """m."""


@functools.cache
def members(num_agents: int) -> tuple[Int[np.ndarray, "P"], Int[np.ndarray, "P"]]:
    """First and second agent of every pair."""
    return np.triu_indices(num_agents, 1)


def between_agents(position: Float[np.ndarray, "B N 2"]) -> Gaps:
    """Gaps and distances within all pairs, (2, P, B) and (P, B)."""
    first, second = members(position.shape[1])
    place = np.ascontiguousarray(position.transpose(2, 1, 0))
    gap = place[:, second]
    gap -= place[:, first]
    return Gaps(gap, _length(gap))


def to_points(position: Float[np.ndarray, "B N 2"], point: Float[np.ndarray, "B L 2"]) -> Gaps:
    """Gaps and distances from every agent to every point, (2, L, N, B) and (L, N, B)."""
    here = np.ascontiguousarray(position.transpose(2, 1, 0))
    there = np.ascontiguousarray(point.transpose(2, 1, 0))
    gap = there[:, :, None] - here[:, None]
    return Gaps(gap, _length(gap))


def of_both(member: Bool[np.ndarray, "B N"]) -> tuple[Bool[np.ndarray, "P B"], Bool[np.ndarray, "P B"]]:
    """Look up what holds for the first and for the second member of each pair."""
    first, second = members(member.shape[1])
    flags = np.ascontiguousarray(member.T)
    return flags[first], flags[second]


def table(holds: Bool[np.ndarray, "P B"], num_agents: int) -> Bool[np.ndarray, "N N B"]:
    """Spread what holds for pairs over a symmetric table, False on the diagonal."""
    first, second = members(num_agents)
    full = np.zeros((num_agents, num_agents, holds.shape[1]), bool)
    full[first, second] = holds
    full[second, first] = holds
    return full


def few(holds: Bool[np.ndarray, "*axes"]) -> tuple[Int[np.ndarray, "n"], ...]:
    """`np.nonzero`, several times faster where few entries of several axes hold."""
    return np.unravel_index(np.flatnonzero(holds), holds.shape)


def repulsion(
    apart: Gaps, solid: Bool[np.ndarray, "B N"], reach: float, stiffness: float, margin: float
) -> Float[np.ndarray, "B N 2"]:
    """Soft contact force on each agent: ``stiffness * margin * softplus((reach - d) / margin)``, N.

    Source: the particle environments' contact law (facts sheet, section 0, "contact"). Pairs that
    stand at the very same place push nowhere: they have no line of centres.

    Args:
        apart: pairs of agents.
        solid: agents that touch others at all.
        reach: sum of two radii, m.
        stiffness: N/m deep inside the contact.
        margin: depth over which the contact sets in, m.
    """
    first, second = members(solid.shape[1])
    which, world = few(apart.distance < reach + _FADE * margin)
    one, other, distance = first[which], second[which], apart.distance[which, world]
    push = solid[world, one] & solid[world, other] & (distance > 0)
    which, world, one, other, distance = which[push], world[push], one[push], other[push], distance[push]
    strength = stiffness * margin * np.logaddexp(0.0, (reach - distance) / margin)
    away = (apart.gap[:, which, world] / distance * strength).T
    force = np.zeros((*solid.shape, 2))
    np.add.at(force, (world, other), away)
    np.subtract.at(force, (world, one), away)
    return force


def _length(gap: Float[np.ndarray, "2 *pairs B"]) -> Float[np.ndarray, "*pairs B"]:
    length, other = gap[0] * gap[0], gap[1] * gap[1]
    length += other
    return np.sqrt(length, out=length)
