"""Some worlds of one evaluation seed, with the changes of a split, in which a policy is rolled out."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

import numpy as np
from jaxtyping import Bool, Float, Int

from hipg_bench.env import NEVER, BatchEnv, Step
from hipg_bench.evaluation.splits import SplitConfig
from hipg_bench.policies.policy import Policy
from hipg_bench.spec import TaskSpec

FORCED = "forced"
"""What those died of whom the split killed."""
_FORCED_CAUSE = -1.0
"""The same in a state row; families count their causes from 0."""


@dataclasses.dataclass(frozen=True)
class Death:
    """One agent's end.

    Attributes:
        agent: whose.
        time: s.
        cause: the family's name for it, or ``forced``.
    """

    agent: int
    time: float
    cause: str


class Worlds:
    """B worlds, each about to play one episode.

    Attributes:
        env: where they are played.
        others: (B, N) bodies that the split's background policy steers.
    """

    def __init__(
        self, spec: TaskSpec, split_config: SplitConfig, seed: int, block: int, ids: Int[np.ndarray, "B"],
        threads: int, *, agent_seed: int,
    ) -> None:  # fmt: skip
        """Build them.

        Args:
            spec: the task.
            split_config: what the split does.
            seed: evaluation seed.
            block: which evaluation seed of the task it is, from 0.
            ids: (B,) episodes.
            threads: physics threads, 0 for all cores.
            agent_seed: what the policy is told for its own chance.
        """
        self.env: BatchEnv = split_config.make(spec, block, len(ids), seed, threads)
        self.others: Bool[np.ndarray, "B N"] = split_config.bodies_of_others(seed, ids, spec.num_agents)
        self._death_schedule = split_config.death_schedule(seed, ids, spec)
        self._background = split_config.background_policy(spec)
        self._seed = seed
        self._agent_seed = agent_seed
        self._ids = ids

    def steps(self, policy: Policy) -> Iterator[Step]:
        """The start, then one step after another, without end."""
        step = self.env.reset(self._ids)
        players = [policy] if self._background is None else [policy, self._background]
        seeds = (self._agent_seed, self._seed)
        memory = [
            one.initial_state(seeds[k], self._ids, self.env.num_agents) for k, one in enumerate(players)
        ]
        while True:
            yield step
            action: list[np.ndarray] = []
            for k, one in enumerate(players):
                seen = step.info["state"] if one.privileged else step.observation
                told, memory[k] = one.act(seen, memory[k], step.info["alive"])
                action.append(told)
            team = action[0] if len(action) == 1 else np.where(self.others[..., None], action[1], action[0])
            step = self._apply_forced_deaths(self.env.step(team))

    def deaths(self, last: Float[np.ndarray, "R"]) -> list[Death]:
        """Who died in an episode, in the order of death, read off its last state row."""
        died_at = self.env.get_field("death_time", last[None])[0]
        cause = self.env.get_field("death_cause", last[None])[0]
        order = sorted(np.flatnonzero(died_at != NEVER).tolist(), key=lambda i: (died_at[i], i))
        return [Death(i, seconds(float(died_at[i]), self.env.spec), self._name(cause[i])) for i in order]

    def _name(self, cause: float) -> str:
        return FORCED if cause == _FORCED_CAUSE else self.env.definition.causes[int(cause)]

    def _apply_forced_deaths(self, step: Step) -> Step:
        """Kill those whose time has come: after a step, before anybody acts on what came of it."""
        going_on = (step.info["episode_id"] == self._ids) & ~(step.terminated | step.truncated)
        due = (self._death_schedule == step.info["elapsed"][:, None]) & step.info["alive"] & going_on[:, None]
        (struck,) = due.any(axis=1).nonzero()
        if not len(struck):
            return step
        rows = self.env.rows[struck]
        for k, b in enumerate(struck.tolist()):
            victims = np.flatnonzero(due[b])
            forked = self.env.fork(rows[k : k + 1], dict.fromkeys(victims.tolist(), 0.0))
            cause = self.env.get_field("death_cause", forked)
            cause[0, victims] = _FORCED_CAUSE
            rows[k] = self.env.set_field(forked, "death_cause", cause)[0]
        now = self.env.load_rows(struck, rows)
        present = {name: now.info[name] for name in ("state", "health", "alive")}
        return dataclasses.replace(step, observation=now.observation, info=step.info | present)


def seconds(steps: float, spec: TaskSpec) -> float:
    """Control steps in s, free of the last bits' noise."""
    return round(steps * spec.control_step, 6)
