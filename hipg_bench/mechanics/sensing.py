"""What an agent perceives of the others: the nearest few, within a radius."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from array_api_compat import array_namespace
from jaxtyping import Bool, Float, Int


class Sensed(NamedTuple):
    """The K nearest things each agent senses, nearest first."""

    which: Int[np.ndarray, "B N K"]
    """Which thing fills the slot; meaningless where the slot is empty."""
    seen: Bool[np.ndarray, "B N K"]
    """Whether the slot is filled."""
    distance: Float[np.ndarray, "B N K"]
    """Distance to it, m; infinite where the slot is empty."""


def nearest_within(
    distance: Float[np.ndarray, "B N M"], visible: Bool[np.ndarray, "#B #N M"], radius: float, slots: int
) -> Sensed:
    """Fill each agent's slots with the nearest visible things within ``radius`` m.

    Args:
        distance: from agents to things, m.
        visible: things that can be sensed at all (not itself, alive or dead as the rule says).
        radius: sensing radius, m.
        slots: K, at most M.
    """
    xp = array_namespace(distance)
    far = xp.where(visible & (distance <= radius), distance, xp.full_like(distance, xp.inf))
    index = xp.argsort(far, axis=-1, stable=True)[..., :slots]
    near = xp.take_along_axis(far, index, axis=-1)
    return Sensed(index, near < xp.inf, near)


def gather(values: Float[np.ndarray, "B M D"], sensed: Sensed) -> Float[np.ndarray, "B N K D"]:
    """Look up each slot's vector; empty slots hold zeros."""
    xp = array_namespace(values)
    rows = xp.arange(values.shape[0])[:, None, None]
    found = values[rows, sensed.which]
    return xp.where(sensed.seen[..., None], found, xp.zeros_like(found))
