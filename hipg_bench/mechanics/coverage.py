"""Who watches which point, and who bumps into whom."""

from __future__ import annotations

import numpy as np
from array_api_compat import array_namespace
from jaxtyping import Bool, Float


def distances(a: Float[np.ndarray, "B P D"], b: Float[np.ndarray, "B Q D"]) -> Float[np.ndarray, "B P Q"]:
    """Euclidean distance between every point of ``a`` and every point of ``b``."""
    xp = array_namespace(a, b)
    gap = a[:, :, None, :] - b[:, None, :, :]
    return xp.sqrt(xp.sum(gap * gap, axis=-1))


def nearest(
    distance: Float[np.ndarray, "B P N"], counts: Bool[np.ndarray, "B N"], nobody: float
) -> Float[np.ndarray, "B P"]:
    """Distance from each point to the nearest agent that counts.

    Args:
        distance: from points to agents, m.
        counts: the agents that can cover a point (usually the living).
        nobody: the distance that stands when no agent counts, and the most that is ever returned, m.
    """
    xp = array_namespace(distance)
    reach = xp.where(counts[:, None, :], distance, xp.full_like(distance, nobody))
    return xp.clip(xp.min(reach, axis=-1), max=nobody)


def contacts(
    distance: Float[np.ndarray, "B N N"], counts: Bool[np.ndarray, "B N"], reach: float
) -> Bool[np.ndarray, "B N N"]:
    """Pairs of distinct agents that count and are nearer than ``reach`` m; symmetric."""
    xp = array_namespace(distance)
    others = ~xp.eye(distance.shape[-1], dtype=xp.bool)
    return (distance < reach) & counts[:, :, None] & counts[:, None, :] & others
