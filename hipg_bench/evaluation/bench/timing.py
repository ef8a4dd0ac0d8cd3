"""Things timed in turn, so that noise hits all of them."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Mapping

import numpy as np
from jaxtyping import Float

_CHUNK = 0.05
"""Seconds a turn of the slowest takes, if one call does not take longer."""
_LEAST = 3
"""Rounds, whatever the time."""


def nothing() -> None:
    """No preparation."""


@dataclasses.dataclass(frozen=True)
class Contender:
    """One of the things compared.

    Attributes:
        call: what is timed.
        prepare: called before each turn, not timed.
    """

    call: Callable[[], object]
    prepare: Callable[[], object] = nothing


@dataclasses.dataclass(frozen=True)
class Times:
    """Seconds per call, by name and round."""

    rounds: Mapping[str, Float[np.ndarray, "rounds"]]

    def median(self, name: str) -> float:
        """Seconds per call."""
        return float(np.median(self.rounds[name]))

    def ratio(self, name: str, base: str) -> float:
        """How many times as long one takes as the other: the median of the rounds' own ratios."""
        return float(np.median(self.rounds[name] / self.rounds[base]))


def in_turn(contenders: Mapping[str, Contender], seconds: float, calls: int | None = None) -> Times:
    """Time contenders in rounds, each as many calls as the others; every second round goes backwards.

    Args:
        contenders: by name.
        seconds: for all together; at least three rounds are run.
        calls: in a turn; by default so many that the slowest takes about 0.05 s.
    """
    first = [_turn(one, 1) for one in contenders.values()]
    if calls is None:
        slowest = max(_turn(one, 2) for one in contenders.values()) if max(first) < _CHUNK else max(first)
        calls = max(1, round(_CHUNK / slowest))
    taken: dict[str, list[float]] = {name: [] for name in contenders}
    until = time.perf_counter() + seconds
    order = list(contenders)
    while time.perf_counter() < until or len(taken[order[0]]) < _LEAST:
        for name in order:
            taken[name].append(_turn(contenders[name], calls))
        order.reverse()
    return Times({name: np.array(values) for name, values in taken.items()})


def _turn(one: Contender, calls: int) -> float:
    """Seconds per call."""
    one.prepare()
    started = time.perf_counter()
    for _ in range(calls):
        one.call()
    return (time.perf_counter() - started) / calls
