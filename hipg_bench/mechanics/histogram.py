"""How many things stand around an agent, by ring and sector: a view of fixed size for any team.

Four rings out to 1 m, their edges evenly spaced in log distance, and eight sectors of 45 degrees
centred on 0, 45, ... degrees from the x axis. Source: the authors' histogram observation (facts
sheet, section 1).
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

RINGS, SECTORS = 4, 8
EDGES = np.logspace(-1, 0, RINGS)
"""Outer edges of the rings, m: 0.1, 0.2154, 0.4642, 1. A thing on an edge is inside."""

_BEYOND = RINGS * SECTORS
"""First cell of those out of range."""
_CELLS = _BEYOND + SECTORS
_HALF_SECTOR = np.tan(np.pi / 8)
# by four bits: 8 nearly along y, 4 nearly along x, 2 y < 0, 1 x < 0
_SECTOR = np.array([1, 3, 7, 5, 0, 4, 0, 4, 2, 2, 6, 6, 0, 4, 0, 4], np.uint8)


def cells(
    gap: Float[np.ndarray, "2 *many"], distance: Float[np.ndarray, "*many"]
) -> UInt8[np.ndarray, "*many"]:
    """Cell, ``ring * 8 + sector``, in which a thing stands; 32 or more where it is out of range.

    Args:
        gap: from the observer to the thing, m.
        distance: length of ``gap``, m.
    """
    x, y = np.abs(gap[0]), np.abs(gap[1])
    code = (y * _HALF_SECTOR >= x).view(np.uint8)
    for bit in (x * _HALF_SECTOR >= y, gap[1] < 0, gap[0] < 0):
        code <<= 1
        code |= bit.view(np.uint8)
    cell = (distance > EDGES[0]).view(np.uint8)
    for edge in EDGES[1:]:
        cell += (distance > edge).view(np.uint8)
    cell <<= 3
    cell += _SECTOR[code]
    return cell


def opposite(cell: UInt8[np.ndarray, "*many"]) -> UInt8[np.ndarray, "*many"]:
    """Cell in which the observer stands as the thing sees it: four sectors on."""
    return cell ^ (SECTORS // 2)


def tally(
    cell: UInt8[np.ndarray, "K B"],
    counted: Bool[np.ndarray, "K B"],
    observer: Int[np.ndarray, "K"],
    num_agents: int,
) -> Int[np.ndarray, "B N 4 8"]:
    """Count things per observer and cell.

    Args:
        cell: of K sightings in every world.
        counted: the sightings that count.
        observer: the agent of each sighting.
        num_agents: N.
    """
    worlds = cell.shape[1]
    index = np.where(counted, cell, np.uint8(_BEYOND)).astype(np.int64)
    index += (np.arange(worlds) * num_agents + observer[:, None]) * _CELLS
    count = np.bincount(index.ravel(), minlength=worlds * num_agents * _CELLS)
    return count.reshape(worlds, num_agents, _CELLS)[..., :_BEYOND].reshape(
        worlds, num_agents, RINGS, SECTORS
    )
