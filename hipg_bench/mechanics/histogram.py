"""How many things stand around an agent, by ring and sector: a view of fixed size for any team.

Four rings out to 1 m, their edges evenly spaced in log distance, and eight sectors of 45 degrees
centred on 0, 45, ... degrees from the x axis. Source: the authors' histogram observation (facts
sheet, section 1).
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, UInt8

RINGS, SECTORS = 4, 8
EDGES = np.logspace(-1, 0, RINGS)
"""Outer edges of the rings, m: 0.1, 0.2154, 0.4642, 1. A thing on an edge is inside."""

_HALF_SECTOR = np.tan(np.pi / 8)
# by four bits: 8 nearly along y, 4 nearly along x, 2 y < 0, 1 x < 0
_SECTOR = np.array([1, 3, 7, 5, 0, 4, 0, 4, 2, 2, 6, 6, 0, 4, 0, 4], np.uint8)


def cells(
    x: Float[np.ndarray, "n"], y: Float[np.ndarray, "n"], distance: Float[np.ndarray, "n"]
) -> UInt8[np.ndarray, "n"]:
    """Cell, ``ring * 8 + sector``, of things within the last edge, m away from the observer."""
    wide, high = np.abs(x), np.abs(y)
    code = (high * _HALF_SECTOR >= wide).view(np.uint8)
    for bit in (wide * _HALF_SECTOR >= high, y < 0, x < 0):
        code <<= 1
        code |= bit.view(np.uint8)
    cell = (distance > EDGES[0]).view(np.uint8)
    for edge in EDGES[1:-1]:
        cell += (distance > edge).view(np.uint8)
    cell <<= 3
    cell += _SECTOR.take(code)
    return cell


def opposite(cell: UInt8[np.ndarray, "n"]) -> UInt8[np.ndarray, "n"]:
    """Cell in which the observer stands as the thing sees it: four sectors on."""
    return cell ^ (SECTORS // 2)
