"""Playing episodes by the protocol: which ones, how many at a time, and what one row says.

World k is episode ``k % 64`` of evaluation seed ``k // 64``; only its first episode counts, so that
short episodes are not counted more often. What a row holds depends on the task, the split, the policy
and the world alone: not on the batch size, the threads or the clock. All agents meet the same worlds.
"""

from __future__ import annotations

import dataclasses
import importlib.metadata
import math
from collections.abc import Callable, Collection, Container, Iterator, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from hipg_bench.env import Step
from hipg_bench.errors import AgentFailure, HipgError, HostFailure
from hipg_bench.evaluation import splits
from hipg_bench.evaluation.failures import (
    NOT_PLAYED,
    OK,
    Watched,
    close,
    counted_return,
    failures_of_a_dnf,
)
from hipg_bench.evaluation.seeds import FIRST_SEED, WORLDS_PER_SEED, hidden_seed
from hipg_bench.evaluation.worlds import FORCED, Worlds
from hipg_bench.policies.policy import Policy
from hipg_bench.registry import definition_of
from hipg_bench.spec import TaskSpec

_COMMON = ("return", "length", "survival", "deaths", "first_death")
"""Metrics every family has; they stand in the row itself."""

Row = dict[str, Any]
"""One episode, ready for JSON; ``docs/concepts/protocol.md`` explains its fields."""
Advance = Callable[[float], None]
"""Told how much was played since last time, in episodes."""


def silent(episodes: float) -> None:
    """Tell nobody."""


@dataclasses.dataclass(frozen=True)
class EvaluationJob:
    """Which worlds are played, and how many at a time.

    Attributes:
        seed: evaluation seed of the first 64 worlds; from 1000 on, since training has those below.
        episodes: worlds per policy.
        num_envs: at most so many worlds at once (64 are of use); no result depends on it.
        threads: physics threads, 0 for all cores; no result depends on it.
        split: what the team meets beside the task; see `hipg_bench.evaluation.splits`.
        salt: hidden worlds follow from it; None plays the public ones.
        agent_seed_key: in hidden worlds, what the agent is told as its own seed follows from this too, so
            that an agent cannot recognise a world from an earlier evaluation by it.
    """

    seed: int = FIRST_SEED
    episodes: int = 320
    num_envs: int = WORLDS_PER_SEED
    threads: int = 0
    split: str = splits.STANDARD
    salt: bytes | None = dataclasses.field(default=None, repr=False)
    agent_seed_key: str = ""

    def eval_seed(self, task: str, world: int) -> int:
        """The environment's seed in a world."""
        block = world // WORLDS_PER_SEED
        return self.seed + block if self.salt is None else hidden_seed(self.salt, self.split, task, block)

    def agent_seed(self, task: str, world: int) -> int:
        """The seed that the policy is told for its own chance."""
        if self.salt is None:
            return self.eval_seed(task, world)
        return hidden_seed(self.salt, f"{self.split}|{self.agent_seed_key}", task, world // WORLDS_PER_SEED)

    def told_seed(self, task: str, world: int) -> int | None:
        """The same as a row tells it: nobody may learn a hidden one."""
        return self.eval_seed(task, world) if self.salt is None else None

    def spec(self, spec: TaskSpec, world: int) -> TaskSpec:
        """The task as it is in a world of the split."""
        return splits.split_config(self.split, spec).spec(spec, world // WORLDS_PER_SEED)

    def episode_id(self, world: int) -> int:
        """Which of the seed's episodes a world is."""
        return world % WORLDS_PER_SEED

    def batches(self, done: Container[int] = ()) -> Iterator[list[int]]:
        """The worlds still to play, in order, those of one batch with the same evaluation seed."""
        for start in range(0, self.episodes, WORLDS_PER_SEED):
            block = range(start, min(start + WORLDS_PER_SEED, self.episodes))
            left = [world for world in block if world not in done]
            for first in range(0, len(left), self.num_envs):
                yield left[first : first + self.num_envs]

    def rows(
        self, spec: TaskSpec, policy: Policy, done: Collection[Row] = (), advance: Advance = silent
    ) -> Iterator[list[Row]]:
        """Play the worlds that are not done, batch by batch; after a DNF enter the rest as not played."""
        left = failures_of_a_dnf(self.episodes) - sum(row["status"] != OK for row in done)
        for worlds in self.batches({row["world"] for row in done}):
            rows = self.play(spec, policy, worlds, advance, failures=left)
            left -= sum(row["status"] not in (OK, NOT_PLAYED) for row in rows)
            yield rows

    def play_all(self, spec: TaskSpec, policy: Policy, advance: Advance = silent) -> list[Row]:
        """Play all worlds."""
        return [row for rows in self.rows(spec, policy, advance=advance) for row in rows]

    def play(
        self,
        spec: TaskSpec,
        policy: Policy,
        worlds: list[int],
        advance: Advance = silent,
        *,
        failures: int | None = None,
    ) -> list[Row]:
        """Play the first episode of worlds that share an evaluation seed.

        Args:
            spec: the task.
            policy: who plays; it is closed at the end.
            worlds: which.
            advance: told of progress.
            failures: after so many failed episodes the worlds that follow are not played.
        """
        left = len(worlds) + 1 if failures is None else failures
        if left > 0 and len(worlds) > 1:
            try:
                return self._play(spec, policy, worlds, advance)
            except AgentFailure:
                pass  # who failed is found out below
        rows: list[Row] = []
        for world in worlds:
            rows += self._play(spec, policy, [world], silent) if left > 0 else [self._not_played(spec, world)]
            left -= rows[-1]["status"] != OK
        advance(len(worlds))
        return rows

    def record(self, spec: TaskSpec, policy: Policy, row: Row) -> Float[np.ndarray, "steps R"]:
        """Play an episode again, alone; return its state rows from the start to the end.

        Raises:
            HipgError: it does not come out as it did: the policy or the physics is not deterministic.
        """
        worlds, watched = self._begin(spec, policy, [row["world"]], threads=1)
        states: list[np.ndarray] = []
        try:
            for step in worlds.steps(watched):
                if step.terminated | step.truncated:
                    states.append(step.info["final_rows"])
                    break
                states.append(worlds.env.rows)
        finally:
            close(policy)
        again = float(worlds.env.get_field("episode_return", states[-1])[0])
        if again != row["reached"]:
            raise HipgError(
                f"{spec.task}: world {row['world']} returned {row['reached']!r}, played again {again!r}; "
                f"the policy's actions depend on more than what it sees and remembers"
            )
        return np.concatenate(states)

    def _begin(
        self, spec: TaskSpec, policy: Policy, worlds: Sequence[int], threads: int
    ) -> tuple[Worlds, Watched]:
        """Build worlds of one block, and watch the policy that is to play them."""
        place = splits.split_config(self.split, spec)
        ids = np.array([self.episode_id(world) for world in worlds])
        seed = self.eval_seed(spec.task, worlds[0])
        told = self.agent_seed(spec.task, worlds[0])
        made = Worlds(spec, place, seed, worlds[0] // WORLDS_PER_SEED, ids, threads, agent_seed=told)
        return made, Watched(policy, made.env.action_size, alone=len(worlds) == 1)

    def _play(self, spec: TaskSpec, policy: Policy, worlds: list[int], advance: Advance) -> list[Row]:
        """Play worlds together, a second time if this machine was at fault.

        Raises:
            AgentFailure: the policy failed, and there are several worlds.
            HostFailure: this machine was at fault twice.
        """
        try:
            return self._play_once(spec, policy, worlds, advance)
        except HostFailure:
            return self._play_once(spec, policy, worlds, advance)

    def _play_once(self, spec: TaskSpec, policy: Policy, worlds: list[int], advance: Advance) -> list[Row]:
        """Play worlds together; with one world alone the agent's failure stands in its row."""
        made, watched = self._begin(spec, policy, worlds, self.threads)
        rows: list[Row] = [{}] * len(worlds)
        running = np.ones(len(worlds), bool)
        told = 0.0
        try:
            for step in made.steps(watched):
                ended = step.terminated | step.truncated
                for place, b in enumerate(np.flatnonzero(ended)):
                    if running[b]:
                        came = _outcome(spec, made, watched.status, step, int(b), place)
                        rows[b] = self._key(spec, worlds[b]) | came
                running &= ~ended
                advance(len(worlds) / spec.horizon)
                told += len(worlds) / spec.horizon
                if not running.any():
                    break
        except (AgentFailure, HostFailure):
            advance(-told)
            raise
        finally:
            close(policy)
        advance(len(worlds) - told)
        return rows

    def _key(self, spec: TaskSpec, world: int) -> Row:
        """Which episode a row is of."""
        block = world // WORLDS_PER_SEED
        return {
            "split": self.split,
            "world": world,
            "eval_seed": self.told_seed(spec.task, world),
            "episode_id": self.episode_id(world),
            "variant": splits.split_config(self.split, spec).variant(block),
        }

    def _not_played(self, spec: TaskSpec, world: int) -> Row:
        """The row of a world that a DNF leaves unplayed."""
        return self._key(spec, world) | {
            "status": NOT_PLAYED,
            "return": spec.floor,
            "reached": None,
            "score": spec.score(spec.floor) if spec.anchors else None,
            "length": None,
            "end_reason": NOT_PLAYED,
            "survival": None,
            "deaths": None,
            "first_death": None,
            "death_list": [],
            "others": [],
            "metrics": dict.fromkeys(definition_of(spec).metrics),
        }


def versions() -> dict[str, str]:
    """Versions on which the last bits of a result may depend."""
    return {name: importlib.metadata.version(name) for name in ("hipg-bench", "mujoco", "numpy")}


def _outcome(spec: TaskSpec, worlds: Worlds, status: str, step: Step, b: int, place: int) -> Row:
    """What came of the episode that just ended in world b; times in s, undefined numbers None.

    Survival and deaths are those of the bodies that the agent steers and the split did not kill.
    """
    metrics = {name: _number(values[b]) for name, values in step.info["metrics"].items()}
    deaths = worlds.deaths(step.info["final_rows"][place])
    others = np.flatnonzero(worlds.others[b]).tolist()
    forced = {death.agent for death in deaths if death.cause == FORCED}
    own = [death for death in deaths if death.agent not in forced and death.agent not in others]
    bodies = spec.num_agents - len(forced | set(others))
    reached = float(step.info["metrics"]["return"][b])
    counted = counted_return(spec, reached, status)
    return {
        "status": status,
        "return": counted,
        "reached": reached,
        "score": spec.score(counted) if spec.anchors else None,
        "length": int(step.info["metrics"]["length"][b]),
        "end_reason": str(step.info["end_reason"][b]),
        "survival": 1.0 - len(own) / bodies if bodies else None,
        "deaths": len(own),
        "first_death": own[0].time if own else None,
        "death_list": [dataclasses.asdict(death) for death in deaths],
        "others": others,
        "metrics": {name: value for name, value in metrics.items() if name not in _COMMON},
    }


def _number(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None
