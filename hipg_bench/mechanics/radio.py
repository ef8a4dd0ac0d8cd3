"""Who reaches whom over radio links, and by how many of them: plain functions of one world."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Int


def count_hops(
    links: Bool[np.ndarray, "M M"], source: int, hops: Int[np.ndarray, "M"], queue: Int[np.ndarray, "M"]
) -> None:
    """Count the fewest links from a source to every node, breadth first.

    Args:
        links: symmetric adjacency of M nodes.
        source: the node to start from.
        hops: written into; 0 to the source itself, -1 where there is no way.
        queue: room to note the nodes that were reached, in order.
    """
    nodes, count, spread = len(links), 1, 0
    for node in range(nodes):
        hops[node] = -1
    hops[source], queue[0] = 0, source
    while spread < count:
        here = queue[spread]
        spread += 1
        for node in range(nodes):
            if links[here, node] and hops[node] < 0:
                hops[node] = hops[here] + 1
                queue[count] = node
                count += 1
