"""Radio links by distance, and who reaches whom over them."""

from __future__ import annotations

import numpy as np
from array_api_compat import array_namespace
from jaxtyping import Bool, Int


def reachable(links: Bool[np.ndarray, "B M M"], source: int) -> Bool[np.ndarray, "B M"]:
    """Nodes connected to node ``source`` over any number of links, itself included.

    The loop is over hops: it ends when no environment's set grows, after at most M rounds.

    Args:
        links: symmetric adjacency of M nodes.
        source: the node to start from.
    """
    xp = array_namespace(links)
    reached = links[:, source, :] | (xp.arange(links.shape[-1]) == source)
    while True:
        further = reached | xp.any(links & reached[:, :, None], axis=1)
        if bool(xp.all(further == reached)):
            return reached
        reached = further


def hops(links: Bool[np.ndarray, "B M M"], source: int, target: int) -> Int[np.ndarray, "B"]:
    """Fewest links between two nodes; 0 where they are not connected."""
    xp = array_namespace(links)
    reached = xp.broadcast_to(xp.arange(links.shape[-1]) == source, links.shape[:2])
    count = xp.zeros(links.shape[0], dtype=xp.int64)
    for hop in range(1, links.shape[-1]):
        further = reached | xp.any(links & reached[:, :, None], axis=1)
        count = xp.where(further[:, target] & ~reached[:, target], hop, count)
        reached = further
    return count
