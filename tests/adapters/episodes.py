"""An episode behind an adapter, and the same one without it."""

from __future__ import annotations

import dataclasses

import numpy as np
from drivers import Adapter, Seen

import hipg_bench
from hipg_bench import BatchEnv, Step


@dataclasses.dataclass(frozen=True)
class Moment:
    """One control step.

    Attributes:
        lived: (N,) who was alive before it.
        seen: what the adapter showed.
        step: what the world itself said.
    """

    lived: np.ndarray
    seen: Seen
    step: Step

    @property
    def died(self) -> np.ndarray:
        """(N,) who died in it."""
        return self.lived & ~self.alive

    @property
    def alive(self) -> np.ndarray:
        """(N,) who is left after it."""
        return self.step.info["final_alive"][0]


def world(task: str, seed: int = 0, **overrides) -> BatchEnv:
    """What every adapter must agree with."""
    return hipg_bench.make(task, 1, seed, threads=1, autoreset=False, **overrides)


def drawn(env: BatchEnv, seed: int, length: int) -> np.ndarray:
    """(length, N, A) random actions, float32 as spaces have them."""
    chance = np.random.default_rng(seed)
    return chance.uniform(-1, 1, (length, env.num_agents, env.action_size)).astype(np.float32)


def played(adapter: Adapter, env: BatchEnv, actions: np.ndarray) -> list[Moment]:
    """Step an adapter and its world, both just reset, until the adapter says that the episode is over."""
    lived, moments = np.ones(env.num_agents, bool), []
    for action in actions:
        step = env.step(action[None])
        moments.append(Moment(lived, adapter.step(action), step))
        lived = moments[-1].alive
        if moments[-1].seen.over:
            break
    return moments
