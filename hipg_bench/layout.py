"""Named blocks of the flat vectors that agents and critics see.

A layout names the numbers of an observation: drones are packed by it, the tables of ``hipg-bench tasks show``
are printed from it, spaces take their limits from it, and learners find the health columns through it.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Mapping

import numpy as np
from jaxtyping import Float

SHARE, UNIT = (0.0, 1.0), (-1.0, 1.0)
"""Limits of flags and health, and of directions and actions."""


@dataclasses.dataclass(frozen=True)
class Block:
    """One named quantity of a flat vector.

    Attributes:
        name: what it is, e.g. ``neighbor_position``.
        shape: its axes within one vector, e.g. ``(7, 3)`` for seven neighbours.
        unit: ``m``, ``m/s``, ``rad``, ``1`` for pure numbers.
        frame: ``world``, ``own`` (relative to the observer), ``body``, or ``-``.
        visible: when the entries hold something; at other times they are 0.
        limits: the least and the largest value.
    """

    name: str
    shape: tuple[int, ...]
    unit: str
    frame: str = "-"
    visible: str = "always"
    limits: tuple[float, float] = (-math.inf, math.inf)

    @property
    def size(self) -> int:
        """Numbers this block takes."""
        return math.prod(self.shape)

    def without(self) -> Block:
        """The same block with nothing in it."""
        return dataclasses.replace(self, shape=(0, *self.shape[1:]))


@dataclasses.dataclass(frozen=True)
class Layout:
    """The blocks of one flat vector, in order."""

    blocks: tuple[Block, ...]

    @functools.cached_property
    def present(self) -> tuple[Block, ...]:
        """The blocks that hold something: a block of size 0 stands for what a variant does not have."""
        return tuple(block for block in self.blocks if block.size)

    @functools.cached_property
    def size(self) -> int:
        """Length of the flat vector."""
        return sum(block.size for block in self.blocks)

    @functools.cached_property
    def slices(self) -> Mapping[str, slice]:
        """Block name to its columns."""
        ends = np.cumsum([block.size for block in self.blocks]).tolist()
        return {
            block.name: slice(end - block.size, end) for block, end in zip(self.blocks, ends, strict=True)
        }

    @functools.cached_property
    def limits(self) -> tuple[Float[np.ndarray, "size"], Float[np.ndarray, "size"]]:
        """The least and the largest value of every number of the flat vector, float32."""
        sizes = [block.size for block in self.blocks]
        low, high = zip(*(block.limits for block in self.blocks), strict=True)
        return np.repeat(np.array(low, np.float32), sizes), np.repeat(np.array(high, np.float32), sizes)

    @functools.cached_property
    def record(self) -> np.dtype[np.void]:
        """One flat vector as a record: its blocks by name."""
        return np.dtype([(block.name, np.float32, block.shape) for block in self.blocks])

    def pack(self, parts: Mapping[str, np.ndarray], lead: tuple[int, ...]) -> Float[np.ndarray, "*lead size"]:
        """Write named arrays into a new float32 array.

        Args:
            parts: one array per block, of shape ``(*lead, *block.shape)`` or broadcastable to it.
            lead: leading axes, ``(B, N)`` for observations and ``(B,)`` for joint states.

        Raises:
            ValueError: the names are not exactly those of the blocks.
        """
        if parts.keys() != self.slices.keys():
            raise ValueError(f"parts {sorted(parts)} do not match the blocks {sorted(self.slices)}")
        record = np.empty(lead, self.record)
        for name, part in parts.items():
            record[name] = part
        return record[..., None].view(np.float32)

    def view(self, flat: np.ndarray, name: str) -> np.ndarray:
        """Return one block of ``flat`` (..., size) with its own axes, as a view where NumPy can."""
        block = next(block for block in self.blocks if block.name == name)
        return flat[..., self.slices[name]].reshape(*flat.shape[:-1], *block.shape)


@dataclasses.dataclass(frozen=True)
class TaskLayout:
    """What a task's agents see and do, and what a central critic sees.

    Attributes:
        observation: one agent's observation, O numbers.
        action: one agent's action, A numbers.
        state: the joint state, S numbers.
        health_block: the state block with one entry per agent that says whether it lives.
        dead_value: what that entry holds at health 0 (1 where the block flags the terminated).
        previous: how many numbers at the end of an observation are those of the step before.
    """

    observation: Layout
    action: Layout
    state: Layout
    health_block: str = "health"
    dead_value: float = 0.0
    previous: int = 0

    @functools.cached_property
    def health_columns(self) -> np.ndarray:
        """(N,) columns of the joint state that a counterfactual critic input overwrites."""
        columns = self.state.slices[self.health_block]
        return np.arange(columns.start, columns.stop)
