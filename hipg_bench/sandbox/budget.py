"""What an agent of others may take: time, memory, words."""

from __future__ import annotations

import dataclasses


@dataclasses.dataclass(frozen=True)
class Budget:
    """Limits of one child process. Times are s of the parent's clock.

    A step of B worlds may take B times ``soft``. What it takes beyond that is paid from the ``bank`` of the
    episodes, and it may go beyond by ``hard - soft`` at most. One world played alone is thus
    held to exactly ``soft``, ``hard`` and ``bank``; a batch to no more than its worlds would be one by one.

    Attributes:
        start_up: loading the agent, making it, and its `reset`.
        soft: a step of one world, all agents together.
        hard: a step of one world, whatever is in the bank.
        bank: what the steps of one episode may take beyond ``soft``, in all.
        memory: address space in bytes.
        words: bytes of the child's output that are kept.
    """

    start_up: float = 60.0
    soft: float = 0.1
    hard: float = 2.0
    bank: float = 10.0
    memory: int = 2 << 30
    words: int = 64 << 10

    def deadline(self, worlds: int) -> float:
        """Longest time that a step of so many worlds may take."""
        return worlds * self.soft + self.hard - self.soft

    def overtime(self, worlds: int, seconds: float) -> float:
        """What a step takes from the bank."""
        return max(0.0, seconds - worlds * self.soft)


PROTOCOL = Budget()
"""The budget of protocol 1."""
