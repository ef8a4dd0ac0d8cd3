"""Distances, sums and orders: plain functions of numbers and small arrays of one world."""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float, Int


def distance3(a: Float[np.ndarray, "3"], b: Float[np.ndarray, "3"]) -> float:
    """Distance between two places in space."""
    x, y, z = a[0] - b[0], a[1] - b[1], a[2] - b[2]
    return math.sqrt(x * x + y * y + z * z)


def mean(part: Float[np.ndarray, "M"]) -> float:
    """Mean, summed as NumPy sums up to 128 numbers: in eight strands."""
    size = len(part)
    whole = size - size % 8 if size >= 8 else 0
    total = 0.0
    if whole > 0:
        a, b, c, d, e, f, g, h = part[0], part[1], part[2], part[3], part[4], part[5], part[6], part[7]
        for k in range(8, whole, 8):
            a, b, c, d = a + part[k], b + part[k + 1], c + part[k + 2], d + part[k + 3]
            e, f, g, h = e + part[k + 4], f + part[k + 5], g + part[k + 6], h + part[k + 7]
        total = ((a + b) + (c + d)) + ((e + f) + (g + h))
    for k in range(whole, size):
        total += part[k]
    return total / size


def rank_within(
    away: Float[np.ndarray, "M"],
    radius: float,
    order: Int[np.ndarray, "M"],
    distance: Float[np.ndarray, "M"],
) -> int:
    """Write which things lie within a radius, nearest first, and how far away; return how many.

    Things as far away as each other go by number.
    """
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
