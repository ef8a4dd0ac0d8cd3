"""An agent plays a split; what comes of it is kept as the board keeps it."""

from __future__ import annotations

import dataclasses
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path

from hipg_bench import registry
from hipg_bench.evaluation import runner
from hipg_bench.evaluation.episodes import Plan
from hipg_bench.evaluation.splits import SPLITS
from hipg_bench.leaderboard.rows import pack
from hipg_bench.leaderboard.shown import Worlds, rows_path, run_path
from hipg_bench.policies.bundle import Agent

SUITE = "standard"
"""Tag of the tasks that the board is about."""

Progress = Callable[[str, float, float], None]
"""Told of a stage, how many more of its episodes are done, and how many it has."""


def quiet(stage: str, done: float, total: float) -> None:
    """Tell nobody."""


@dataclasses.dataclass(frozen=True)
class Match:
    """What is played for an entry.

    Attributes:
        tasks: names; by default the whole suite.
        splits: names; by default all.
        episodes: worlds per policy, task and split; fewer than 320 are for trying out.
        threads: physics threads, 0 for all cores.
    """

    tasks: tuple[str, ...] = dataclasses.field(default_factory=lambda: registry.tagged(SUITE))
    splits: tuple[str, ...] = SPLITS
    episodes: int = 320
    threads: int = 0

    def suite(self) -> runner.Suite:
        """The tasks."""
        return runner.Suite(SUITE, tuple(registry.task_spec(task) for task in self.tasks))

    def plan(self, split: str, salt: bytes | None = None) -> Plan:
        """The worlds of a split: public ones, or those hidden behind a salt."""
        return Plan(episodes=self.episodes, threads=self.threads, split=split, salt=salt)


def play(
    agent: Agent, match: Match, split: str, work: Path, salt: bytes | None = None, progress: Progress = quiet
) -> Path:
    """Play a split, or finish what lies in ``work``; return the evaluation's folder.

    Raises:
        BundleError: the agent plays none of the tasks.
        ResumeError: the rows in ``work`` are of another agent, task or version.
    """
    worlds: Worlds = "public" if salt is None else "hidden"
    suite = match.suite()
    seeds, _ = runner.playable(agent, suite)
    total = match.episodes * sum(len(found) for found in seeds.values())
    stage = f"{split}, {worlds} worlds"
    progress(stage, 0.0, total)
    out = work / run_path(worlds, split)
    runner.evaluate(
        agent, suite, out, match.plan(split, salt),
        progress=lambda task, done: progress(stage, done, total) if task in seeds else None,
    )  # fmt: skip
    return out


def keep(run: Path, entry: Path, worlds: Worlds, split: str) -> dict[str, str]:
    """Copy results and packed rows into an entry; return the rows' hashes by path."""
    target = entry / run_path(worlds, split)
    target.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(run / "results.json", target / "results.json")
    return {
        (path := rows_path(worlds, split, rows.stem)): pack(rows.read_bytes(), entry / path)
        for rows in sorted((run / "episodes").glob("*.jsonl"))
    }


def played_tasks(run: Path) -> Sequence[str]:
    """Tasks that an evaluation has rows of."""
    return [rows.stem for rows in sorted((run / "episodes").glob("*.jsonl"))]
