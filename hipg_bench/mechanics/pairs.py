"""Every unordered pair of agents once: half the work of an (N, N) table, along axes that stay long.

Arrays run (P, B), worlds last, so that each operation sweeps over all worlds in one go. N agents
make P = N (N - 1) / 2 pairs, in the order (0, 1), (0, 2), ..., (N - 2, N - 1).
"""

from __future__ import annotations

import functools
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

_FADE = 40.0
"""Margins beyond contact at which softplus is below 1e-17, and the push is left out."""


class Pairs(NamedTuple):
    """How pairs of agents stand to each other in the plane."""

    gap: Float[np.ndarray, "2 P B"]
    """From the first member to the second, m."""
    distance: Float[np.ndarray, "P B"]
    """m."""


@functools.cache
def members(num_agents: int) -> tuple[Int[np.ndarray, "P"], Int[np.ndarray, "P"]]:
    """First and second agent of every pair."""
    return np.triu_indices(num_agents, 1)


def pairs(position: Float[np.ndarray, "B N 2"]) -> Pairs:
    """Gaps and distances within all pairs."""
    first, second = members(position.shape[1])
    place = np.ascontiguousarray(position.transpose(2, 1, 0))
    gap = place[:, second] - place[:, first]
    return Pairs(gap, np.sqrt(gap[0] * gap[0] + gap[1] * gap[1]))


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


def repulsion(
    apart: Pairs, solid: Bool[np.ndarray, "B N"], reach: float, stiffness: float, margin: float
) -> Float[np.ndarray, "B N 2"]:
    """Soft contact force on each agent: ``stiffness * margin * softplus((reach - d) / margin)``, N.

    Source: the particle environments' contact law (facts sheet, section 0, "contact"). Pairs that
    stand at the very same place push nowhere: they have no line of centres.

    Args:
        apart: the pairs.
        solid: agents that touch others at all.
        reach: sum of two radii, m.
        stiffness: N/m deep inside the contact.
        margin: depth over which the contact sets in, m.
    """
    first, second = members(solid.shape[1])
    one, other = of_both(solid)
    near = (apart.distance < reach + _FADE * margin) & (apart.distance > 0) & one & other
    which, world = np.nonzero(near)
    gap, distance = apart.gap[:, which, world], apart.distance[which, world]
    strength = stiffness * margin * np.logaddexp(0.0, (reach - distance) / margin)
    push = (gap / distance * strength).T
    force = np.zeros((*solid.shape, 2))
    np.add.at(force, (world, second[which]), push)
    np.subtract.at(force, (world, first[which]), push)
    return force
