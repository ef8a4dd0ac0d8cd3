"""Playing episodes by the protocol: which ones, how many at a time, and what one row says.

World k has evaluation seed ``seed + k // 64`` and episode ``k % 64``; only its first episode counts,
so that short episodes are not counted more often. What a row holds depends on the task, the policy
and the world alone: not on the batch size, the threads or the clock.
"""

from __future__ import annotations

import dataclasses
import importlib.metadata
import math
from collections.abc import Callable, Container, Iterator
from typing import Any

import numpy as np
from jaxtyping import Float

from hipg_bench import registry
from hipg_bench.env import NEVER, BatchEnv, Step
from hipg_bench.errors import HipgError
from hipg_bench.policies.policy import Policy
from hipg_bench.spec import TaskSpec

WORLDS_PER_SEED = 64
"""Worlds that share an evaluation seed."""
_COMMON = ("return", "length", "survival", "deaths", "first_death")
"""Metrics every family has; they stand in the row itself."""

Row = dict[str, Any]
"""One episode, ready for JSON."""
Advance = Callable[[float], None]
"""Told how much was played since last time, in episodes."""


def silent(episodes: float) -> None:
    """Tell nobody."""


@dataclasses.dataclass(frozen=True)
class Plan:
    """Which worlds are played, and how many at a time.

    Attributes:
        seed: evaluation seed of the first 64 worlds; from 1000 on, since training has those below.
        episodes: worlds per policy.
        num_envs: at most so many worlds at once (64 are of use); no result depends on it.
        threads: physics threads, 0 for all cores; no result depends on it.
    """

    seed: int = 1000
    episodes: int = 320
    num_envs: int = WORLDS_PER_SEED
    threads: int = 0

    def eval_seed(self, world: int) -> int:
        """The environment's seed in a world."""
        return self.seed + world // WORLDS_PER_SEED

    def batches(self, done: Container[int] = ()) -> Iterator[list[int]]:
        """The worlds still to play, in order, those of one batch with the same evaluation seed."""
        for start in range(0, self.episodes, WORLDS_PER_SEED):
            block = range(start, min(start + WORLDS_PER_SEED, self.episodes))
            left = [world for world in block if world not in done]
            for first in range(0, len(left), self.num_envs):
                yield left[first : first + self.num_envs]

    def play(self, spec: TaskSpec, policy: Policy, worlds: list[int], advance: Advance = silent) -> list[Row]:
        """Play the first episode of worlds that share an evaluation seed."""
        seed = self.eval_seed(worlds[0])
        ids = np.array([world % WORLDS_PER_SEED for world in worlds])
        env = registry.make(spec, len(worlds), seed, threads=self.threads)
        rows: list[Row] = [{}] * len(worlds)
        running = np.ones(len(worlds), bool)
        told = 0.0
        for step in _steps(env, policy, seed, ids):
            ended = step.terminated | step.truncated
            for place, b in enumerate(np.flatnonzero(ended)):
                if running[b]:
                    key = {"world": worlds[b], "eval_seed": seed, "episode_id": int(ids[b])}
                    rows[b] = key | _outcome(env, step, int(b), step.info["final_rows"][place])
            running &= ~ended
            advance(len(worlds) / spec.horizon)
            told += len(worlds) / spec.horizon
            if not running.any():
                break
        advance(len(worlds) - told)
        return rows

    def play_all(self, spec: TaskSpec, policy: Policy, advance: Advance = silent) -> list[Row]:
        """Play all worlds."""
        return [row for worlds in self.batches() for row in self.play(spec, policy, worlds, advance)]

    def record(self, spec: TaskSpec, policy: Policy, row: Row) -> Float[np.ndarray, "steps R"]:
        """Play an episode again, alone; return its state rows from the start to the end.

        Raises:
            HipgError: it does not come out as it did: the policy or the physics is not deterministic.
        """
        env = registry.make(spec, 1, row["eval_seed"], threads=1)
        states: list[np.ndarray] = []
        for step in _steps(env, policy, row["eval_seed"], np.array([row["episode_id"]])):
            if step.terminated | step.truncated:
                states.append(step.info["final_rows"])
                break
            states.append(env.rows)
        again = float(env.recall(states[-1], "return")[0, 0])
        if again != row["return"]:
            raise HipgError(
                f"{spec.task}: world {row['world']} returned {row['return']!r}, played again {again!r}; "
                f"the policy's actions depend on more than what it sees and remembers"
            )
        return np.concatenate(states)


def versions() -> dict[str, str]:
    """Versions on which the last bits of a result may depend."""
    return {name: importlib.metadata.version(name) for name in ("hipg-bench", "mujoco", "numpy")}


def _steps(env: BatchEnv, policy: Policy, seed: int, ids: np.ndarray) -> Iterator[Step]:
    """The start, then one step after another, without end."""
    step = env.reset(ids)
    memory = policy.initial_state(seed, ids, env.num_agents)
    while True:
        yield step
        seen = step.info["state"] if policy.privileged else step.observation
        action, memory = policy.act(seen, memory, step.info["alive"])
        step = env.step(action)


def _outcome(env: BatchEnv, step: Step, b: int, last: Float[np.ndarray, "R"]) -> Row:
    """What came of the episode that just ended in world b; times in s, undefined numbers None."""
    died_at = env.recall(last[None], "death_time")[0]
    cause = env.recall(last[None], "death_cause")[0]
    died = sorted((float(died_at[i]), int(i)) for i in np.flatnonzero(died_at != NEVER))
    metrics = {name: _number(values[b]) for name, values in step.info["metrics"].items()}
    first_death = metrics["first_death"]
    episode_return = float(step.info["metrics"]["return"][b])
    return {
        "return": episode_return,
        "score": env.spec.score(episode_return) if env.spec.anchors else None,
        "length": int(step.info["metrics"]["length"][b]),
        "end_reason": str(step.info["end_reason"][b]),
        "survival": metrics["survival"],
        "deaths": len(died),
        "first_death": None if first_death is None else _seconds(first_death, env.spec),
        "death_list": [
            {"agent": i, "time": _seconds(at, env.spec), "cause": env.family.causes[int(cause[i])]}
            for at, i in died
        ],
        "metrics": {name: value for name, value in metrics.items() if name not in _COMMON},
    }


def _seconds(steps: float, spec: TaskSpec) -> float:
    """Control steps in s, free of the last bits' noise."""
    return round(steps * spec.control_step, 6)


def _number(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None
