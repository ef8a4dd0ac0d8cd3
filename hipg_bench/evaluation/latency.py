"""How long an agent thinks. Rows never hold it: they are the same on every machine."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from hipg_bench.evaluation.failures import close
from hipg_bench.policies.policy import Policy


class Stopwatch:
    """Collects the time that policies take for an action, in ms per world and step."""

    def __init__(self) -> None:
        self.laps: list[float] = []

    def timed(self, policy: Policy) -> Policy:
        """The same policy, measured."""
        return _Timed(policy, self.laps)

    def summary(self) -> dict[str, float] | None:
        """Median and 99th percentile; None if nothing was played."""
        if not self.laps:
            return None
        median, slow = np.percentile(self.laps, [50, 99])
        return {"p50": round(float(median), 4), "p99": round(float(slow), 4)}


class _Timed:
    """A policy and its laps."""

    def __init__(self, policy: Policy, laps: list[float]) -> None:
        self.privileged = policy.privileged
        self._policy = policy
        self._laps = laps

    def initial_state(self, seed: int, episode_id: Int[np.ndarray, "B"], num_agents: int) -> Any:
        return self._policy.initial_state(seed, episode_id, num_agents)

    def act(
        self, seen: np.ndarray, memory: Any, alive: Bool[np.ndarray, "B N"]
    ) -> tuple[Float[np.ndarray, "B N A"], Any]:
        started = time.perf_counter()
        answer = self._policy.act(seen, memory, alive)
        self._laps.append(1000 * (time.perf_counter() - started) / len(alive))
        return answer

    def close(self) -> None:
        close(self._policy)
