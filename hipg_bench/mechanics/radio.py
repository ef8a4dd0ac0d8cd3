"""Who reaches whom over radio links, and by how many of them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Int8


def hops(links: Bool[np.ndarray, "M M B"], sources: Sequence[int]) -> Int8[np.ndarray, "S M B"]:
    """Fewest links from each of S sources to every node; 0 to itself, -1 where there is no way.

    The loop is over hops: it ends when no world's set of reached nodes grows, after at most M rounds.

    Args:
        links: symmetric adjacency of M nodes, at most 64; worlds last.
        sources: the nodes to start from.
    """
    nodes, _, worlds = links.shape
    # a set of nodes is one word, node j its bit j: a link into the set is then a common bit
    word = np.uint32 if nodes <= 32 else np.uint64
    bit = word(1) << np.arange(nodes, dtype=word)
    heard = np.einsum("ijb,j->ib", links, bit)
    inside = np.zeros((len(sources), nodes, worlds), bool)
    inside[np.arange(len(sources)), sources] = True
    count = np.zeros(inside.shape, np.int8)
    while True:
        reached = np.bitwise_or.reduce(inside * bit[:, None], axis=1, keepdims=True)
        further = inside | ((heard & reached) != 0)
        if (further == inside).all():
            return np.where(inside, count, np.int8(-1))
        count += ~inside
        inside = further


def reachable(links: Bool[np.ndarray, "B M M"], source: int) -> Bool[np.ndarray, "B M"]:
    """Nodes connected to node ``source`` over any number of links, itself included; worlds first."""
    return hops(np.moveaxis(links, 0, -1), [source])[0].T >= 0
