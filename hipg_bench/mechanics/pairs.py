"""Gaps in the plane: between all agents, and from agents to points.

Arrays run along the worlds, B last, so that each operation sweeps over all worlds in one go; that is
several times faster than with short last axes. N agents make P = N (N - 1) / 2 pairs, each of them
once, in the order (0, 1), (0, 2), ..., (N - 2, N - 1); L points make L N further gaps, point by point.
"""

from __future__ import annotations

import functools
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

_FADE = 40.0
"""Margins beyond contact at which softplus is below 1e-17, and the push is left out."""


class Gaps(NamedTuple):
    """How N agents stand to each other and to L points: K = P + L N gaps."""

    num_agents: int
    gap: Float[np.ndarray, "2 K B"]
    """From the first agent of a pair to the second, or from the agent to the point, m."""
    distance: Float[np.ndarray, "K B"]
    """m."""

    @property
    def apart(self) -> Float[np.ndarray, "P B"]:
        """Distance within each pair of agents, m."""
        return self.distance[: count(self.num_agents)]

    @property
    def away(self) -> Float[np.ndarray, "L N B"]:
        """Distance from each point to each agent, m."""
        return self.distance[count(self.num_agents) :].reshape(-1, self.num_agents, self.distance.shape[1])


class Contacts(NamedTuple):
    """M pairs of agents that are near each other, over all worlds."""

    world: Int[np.ndarray, "M"]
    one: Int[np.ndarray, "M"]
    other: Int[np.ndarray, "M"]
    """Agents, counted through all worlds: N world + agent."""
    gap: Float[np.ndarray, "2 M"]
    """From one to the other, m."""
    distance: Float[np.ndarray, "M"]
    """m."""


def count(num_agents: int) -> int:
    """P, the number of pairs."""
    return num_agents * (num_agents - 1) // 2


@functools.cache
def members(num_agents: int) -> tuple[Int[np.ndarray, "P"], Int[np.ndarray, "P"]]:
    """First and second agent of every pair."""
    return np.triu_indices(num_agents, 1)


def gaps(position: Float[np.ndarray, "B N 2"], point: Float[np.ndarray, "B L 2"]) -> Gaps:
    """Measure all gaps, m."""
    worlds, agents, _ = position.shape
    first, second = members(agents)
    here, there = (np.ascontiguousarray(place.transpose(2, 1, 0)) for place in (position, point))
    gap = np.empty((2, len(first) + point.shape[1] * agents, worlds))
    np.subtract(here.take(second, axis=1), here.take(first, axis=1), out=gap[:, : len(first)])
    away = gap[:, len(first) :].reshape(2, -1, agents, worlds, copy=False)
    np.subtract(there[:, :, None], here[:, None], out=away)
    square = gap * gap
    square[0] += square[1]
    return Gaps(agents, gap, np.sqrt(square[0], out=square[0]))


def contacts(all_gaps: Gaps, reach: float, margin: float) -> Contacts:
    """Pairs of agents near enough for `repulsion` to push them apart."""
    which, world = few(all_gaps.apart < reach + _FADE * margin)
    first, second = members(all_gaps.num_agents)
    own = world * all_gaps.num_agents
    gap, distance = all_gaps.gap[:, which, world], all_gaps.distance[which, world]
    return Contacts(world, own + first[which], own + second[which], gap, distance)


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


def linked(
    links: Bool[np.ndarray, "N N B"], start: Bool[np.ndarray, "N B"], goal: Bool[np.ndarray, "N B"]
) -> Bool[np.ndarray, "B"]:
    """Whether links lead from some agent of ``start`` to some agent of ``goal``.

    The loop is over hops: it ends when no world's set of reached agents grows, after at most N rounds.
    """
    reached, further = start, start | (links & start[:, None]).any(axis=0)
    while (further != reached).any():
        reached, further = further, further | (links & further[:, None]).any(axis=0)
    return np.logical_or.reduce(reached & goal, axis=0)


def few(holds: Bool[np.ndarray, "*axes"]) -> tuple[Int[np.ndarray, "n"], ...]:
    """`np.nonzero`, several times faster where few entries of several axes hold."""
    return np.unravel_index(holds.ravel().nonzero()[0], holds.shape)


def repulsion(
    contact: Contacts, solid: Bool[np.ndarray, "B N"], reach: float, stiffness: float, margin: float
) -> Float[np.ndarray, "B N 2"]:
    """Soft contact force on each agent: ``stiffness * margin * softplus((reach - d) / margin)``, N.

    Source: the particle environments' contact law (facts sheet, section 0, "contact"). Pairs that
    stand at the very same place push nowhere: they have no line of centres.

    Args:
        contact: pairs of agents that may push each other.
        solid: agents that touch others at all.
        reach: sum of two radii, m.
        stiffness: N/m deep inside the contact.
        margin: depth over which the contact sets in, m.
    """
    holds = solid.ravel()
    (push,) = np.nonzero(holds[contact.one] & holds[contact.other] & (contact.distance > 0))
    if not len(push):
        return np.zeros((*solid.shape, 2))
    distance = contact.distance[push]
    strength = stiffness * margin * np.logaddexp(0.0, (reach - distance) / margin)
    away = contact.gap[:, push] / distance * strength
    whom = 2 * np.concatenate([contact.other[push], contact.one[push]])
    part = np.concatenate([away, -away], axis=1)
    force = np.bincount((whom + np.arange(2)[:, None]).ravel(), part.ravel(), 2 * solid.size)
    return force.reshape(*solid.shape, 2)
