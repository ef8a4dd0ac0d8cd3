"""An agent plays a split; what comes of it is kept as the board keeps it."""

from __future__ import annotations

import dataclasses
import json
import shutil
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, cast

from hipg_bench import registry
from hipg_bench.errors import BoardError
from hipg_bench.evaluation import runner, splits
from hipg_bench.evaluation.episodes import EvaluationJob, Row
from hipg_bench.evaluation.results import aggregate
from hipg_bench.evaluation.rows import read_rows
from hipg_bench.evaluation.splits import SPLITS
from hipg_bench.leaderboard.entry_view import Worlds, rows_path, run_path
from hipg_bench.leaderboard.rows import pack
from hipg_bench.paths import write_text
from hipg_bench.policies.bundle import Agent

ALL = "all"
"""The table over all families."""
SUITE = "standard"
"""Tag of the tasks that the board is about."""

Progress = Callable[[str, float, float], None]
"""Told of a stage, how many more of its episodes are done, and how many it has."""


def quiet(stage: str, done: float, total: float) -> None:
    """Tell nobody."""


MOST_HOURS = 48.0
"""Wall-clock time that an entry may play in one `add` or `verify`, h."""


def limited(progress: Progress, hours: float = MOST_HOURS) -> Progress:
    """The same, but it ends what it is told of after so many hours from now.

    Every step of an agent has a limit of its own; together those of a whole suite would take weeks.

    Raises:
        BoardError: when it is told of anything after that.
    """
    deadline = time.monotonic() + 3600 * hours

    def tell(stage: str, done: float, total: float) -> None:
        if time.monotonic() > deadline:
            raise BoardError(f"{stage}: the entry has played for {hours:g} hours in all, which is the limit")
        progress(stage, done, total)

    return tell


@dataclasses.dataclass(frozen=True)
class BoardEvaluation:
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

    def job(self, split: str, salt: bytes | None = None, agent_seed_key: str = "") -> EvaluationJob:
        """The worlds of a split: public ones, or those hidden behind a salt, as `EvaluationJob` describes."""
        return EvaluationJob(
            episodes=self.episodes,
            threads=self.threads,
            split=split,
            salt=salt,
            agent_seed_key=agent_seed_key,
        )


def play(
    agent: Agent,
    evaluation: BoardEvaluation,
    split: str,
    work: Path,
    salt: bytes | None = None,
    agent_seed_key: str = "",
    progress: Progress = quiet,
) -> Path:
    """Play a split, or finish what lies in ``work``; return the evaluation's folder.

    Raises:
        BundleError: the agent plays none of the tasks.
        ResumeError: the rows in ``work`` are of another agent, task or version.
    """
    worlds: Worlds = "public" if salt is None else "hidden"
    suite = evaluation.suite()
    seeds, _ = runner.playable(agent, suite)
    total = evaluation.episodes * sum(len(found) for found in seeds.values())
    stage = f"{split}, {worlds} worlds"
    progress(stage, 0.0, total)
    out = work / run_path(worlds, split)
    runner.evaluate(
        agent, suite, out, evaluation.job(split, salt, agent_seed_key),
        progress=lambda task, done: progress(stage, done, total) if task in seeds else None,
    )  # fmt: skip
    return out


def keep(run: Path, entry: Path, split: str) -> dict[str, str]:
    """Copy results and packed rows of public worlds into an entry; return the rows' hashes by path."""
    target = entry / run_path("public", split)
    target.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(run / "results.json", target / "results.json")
    return _pack_rows(run, entry, "public", split)


def keep_hidden(run: Path, entry: Path, private: Path, split: str) -> dict[str, str]:
    """The same of hidden worlds: rows go to the host's own folder, and rounded results into the entry.

    What an agent saw in a hidden world could be told by what it does in it, and so be read out of its rows.
    The hashes bind the host to them until the salt is revealed.
    """
    result = json.loads((run / "results.json").read_text(encoding="utf-8"))
    result["tables"] = _by_table(run, split)
    target = entry / run_path("hidden", split)
    target.mkdir(parents=True, exist_ok=True)
    write_text(target / "results.json", json.dumps(_rounded(result), indent=2, allow_nan=False) + "\n")
    return _pack_rows(run, private, "hidden", split)


def _pack_rows(run: Path, folder: Path, worlds: Worlds, split: str) -> dict[str, str]:
    return {
        (path := rows_path(worlds, split, rows.stem)): pack(rows.read_bytes(), folder / path)
        for rows in sorted((run / "episodes").glob("*.jsonl"))
    }


def _by_table(run: Path, split: str) -> dict[str, Any]:
    """What the suite and each of its families come to, which nobody can compute without the rows."""
    suite = [splits.with_anchors(split, registry.task_spec(task)) for task in registry.tagged(SUITE)]
    rows: dict[str, list[Row]] = {}
    for spec in suite:
        path = run / "episodes" / f"{spec.task}.jsonl"
        rows[spec.task] = read_rows(path.read_bytes(), str(path), spec) if path.exists() else []
    tables = {ALL: suite, **{spec.family: [] for spec in suite}}
    for spec in suite:
        tables[spec.family].append(spec)
    return {name: aggregate([(spec, rows[spec.task]) for spec in chosen]) for name, chosen in tables.items()}


def _rounded(value: Any) -> Any:
    """Numbers with three significant digits, in whatever they stand."""
    if isinstance(value, float):
        return float(f"{value:.3g}")
    if isinstance(value, dict):
        return {name: _rounded(one) for name, one in cast(dict[str, Any], value).items()}
    return [_rounded(one) for one in cast(list[Any], value)] if isinstance(value, list) else value


def played_tasks(run: Path) -> Sequence[str]:
    """Tasks that an evaluation has rows of."""
    return [rows.stem for rows in sorted((run / "episodes").glob("*.jsonl"))]
