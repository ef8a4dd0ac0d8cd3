"""`add`: an agent becomes an entry, with rows on the public worlds, curves and films.

The rows are the submitter's own, where they come along as ``<split>/episodes/<task>.jsonl``; else the board
plays them. Nothing else that a submitter says of results is used.
"""

from __future__ import annotations

import contextlib
import csv
import dataclasses
import itertools
import math
import shutil
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, cast

import numpy as np

from hipg_bench.documents import read_json
from hipg_bench.errors import BoardError, BundleError, SpecError
from hipg_bench.evaluation import runner
from hipg_bench.evaluation.failures import OK
from hipg_bench.evaluation.rows import read_rows
from hipg_bench.leaderboard import films
from hipg_bench.leaderboard.board import Board
from hipg_bench.leaderboard.entry import Entry, now
from hipg_bench.leaderboard.entry_view import rows_path, run_path
from hipg_bench.leaderboard.playing import BoardEvaluation, Progress, keep, limited, play, played_tasks, quiet
from hipg_bench.leaderboard.rows import MOST_BYTES
from hipg_bench.leaderboard.source import BUNDLE, Source
from hipg_bench.paths import write_text
from hipg_bench.policies.bundle import Agent
from hipg_bench.policies.card import check_regular
from hipg_bench.registry import task_spec
from hipg_bench.submissions.check import check

CURVE_POINTS = 300
"""Kept of a learning curve."""
_MOST_CURVE_BYTES = 8_000_000
_MOST_TOLD = 20
_LARGEST = 1e15
"""Largest number of a learning curve."""
_ALIKE = 1e-3
"""Share of the spread over worlds within which returns of two trainings are those of one."""


@dataclasses.dataclass(frozen=True)
class Added:
    """What came of it: the entry, self-reported, and why films are missing."""

    entry: Entry
    trouble: tuple[str, ...]


def add(
    board: Board,
    source: Source,
    evaluation: BoardEvaluation,
    *,
    claims: Path | None = None,
    replace: bool = False,
    film_tasks: Sequence[str] = (),
    progress: Progress = quiet,
) -> Added:
    """Put an agent on the board; the entry appears whole, at the end.

    Args:
        board: where.
        source: who.
        evaluation: what is played.
        claims: folder with the submitter's rows, if they are to be compared with later.
        replace: take the place of an entry of the same name, which goes into the board's history.
        film_tasks: of which tasks a film is made.
        progress: told how far it is.

    Raises:
        BoardError: the name is taken, or the claimed rows are none.
        BundleError: `submit check` finds an error, the agent plays none of the tasks, or two of its training
            seeds played alike.
        SpecError: the claimed rows are refused.
        ResumeError: the claimed rows are of another agent, suite or version.
    """
    agent, progress = source.agent, limited(progress)
    if source.bundle is not None:
        _refuse_faulty(agent)
    earlier = board.entry(agent.name) if replace and agent.name in board.names() else None
    with board.draft(agent.name, earlier) as folder:
        _copy_card(source, folder)
        work = folder / ".work"
        claimed = [
            split
            for split in evaluation.splits
            if claims is not None and _bring(claims, split, work, agent, evaluation)
        ]
        if claims is not None and not claimed:
            raise BoardError(f"{claims} holds no rows: <split>/episodes/<task>.jsonl is expected")
        hashes: dict[str, str] = {}
        for split in evaluation.splits:
            run = play(agent, evaluation, split, work, progress=progress)
            _refuse_alike(run)
            hashes |= keep(run, folder, split)
        _copy_curves(agent, folder)
        _keep_films(board, earlier, hashes, folder)
        trouble = films.make(agent, evaluation, film_tasks, work, folder, progress)
        policies = {task: agent.train_seeds(task) for task in played_tasks(work / evaluation.splits[0])}
        privileged = any(
            agent.policy(task_spec(task), seeds[0]).privileged for task, seeds in policies.items()
        )
        entry = Entry(
            name=agent.name,
            version=earlier.version if earlier and source.bundle is None else board.next_version(agent.name),
            added=now(),
            suite=agent.card.suite,
            tier=agent.card.tier,
            bundle=source.digest,
            policies={
                task: {seed: agent.fingerprint(task, seed) for seed in seeds}
                for task, seeds in policies.items()
            },
            claimed=bool(claimed),
            sandbox=source.sandbox,
            execution="centralised" if privileged else agent.card.execution,
            privileged=privileged,
            rows=hashes,
        )
        shutil.rmtree(work)
        board.write(folder, entry)
    return Added(entry, tuple(trouble))


def _refuse_faulty(agent: Agent) -> None:
    """Refuse what `submit check` would refuse."""
    errors = [
        f"{finding.where}: {finding.what}"
        for finding in check(agent.folder, trust=agent.trust)
        if finding.severity == "error"
    ]
    if errors:
        raise BundleError(
            f"{agent.name} is not ready for the board (`hipg-bench submit check` says what to do):\n  "
            + "\n  ".join(errors[:_MOST_TOLD])
        )


def _copy_card(source: Source, folder: Path) -> None:
    shutil.copyfile(source.agent.folder / "agent.toml", folder / "agent.toml")
    readme = source.agent.folder / "README.md"
    if readme.is_file():
        shutil.copyfile(readme, folder / "README.md")
    if source.bundle is not None:
        shutil.copyfile(source.bundle, folder / BUNDLE)


def _keep_films(board: Board, earlier: Entry | None, hashes: Mapping[str, str], folder: Path) -> None:
    """Take over the films of an entry that is replaced, where the episodes are the same."""
    if earlier is not None:
        for film in sorted((board.folder(earlier.name) / "films").glob("*.mp4")):
            path = rows_path("public", "standard", film.stem)
            if hashes.get(path) is not None and hashes[path] == earlier.rows.get(path):
                (folder / "films").mkdir(exist_ok=True)
                shutil.copyfile(film, folder / "films" / film.name)


def _bring(claims: Path, split: str, work: Path, agent: Agent, evaluation: BoardEvaluation) -> bool:
    """Lay claimed rows where the evaluation goes on from them; say whether there are any.

    Raises:
        BoardError: rows of a task that is not played here, or a file that is none or too large.
        SpecError: the rows are refused.
    """
    played, _ = runner.playable(agent, evaluation.suite())
    found = sorted((claims / split / "episodes").glob("*.jsonl"))
    for path in found:
        if path.stem not in played:
            raise BoardError(
                f"{path}: rows of {path.stem}, which {agent.name} does not play here; "
                f"it plays {', '.join(played)}"
            )
        try:
            check_regular(path)
        except BundleError as error:
            raise BoardError(str(error)) from error
        if path.stat().st_size > MOST_BYTES:
            raise BoardError(f"{path}: at most {MOST_BYTES} bytes of rows are allowed")
        text = path.read_bytes()
        read_rows(text, path.name, task_spec(path.stem))
        target = work / run_path("public", split) / "episodes" / path.name
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_bytes(text)
    return bool(found)


def _refuse_alike(run: Path) -> None:
    """Refuse training seeds that played alike: they are copies of one training, or almost.

    Two are alike if in half of the worlds that both finished, their returns differ by less than
    `_ALIKE` of how much returns vary between worlds.

    Raises:
        BundleError: there are such.
    """
    for path in sorted((run / "episodes").glob("*.jsonl")):
        played: dict[int, dict[int, float]] = {}
        for row in read_rows(path.read_bytes(), str(path), task_spec(path.stem)):
            if row["status"] == OK:
                played.setdefault(row["train_seed"], {})[row["world"]] = row["return"]
        for (first, one), (second, other) in itertools.combinations(played.items(), 2):
            common = sorted(one.keys() & other.keys())
            if not common:
                continue
            a, b = (np.array([returns[world] for world in common]) for returns in (one, other))
            rounding = 1e-9 * float(np.abs(a).max())
            if np.median(np.abs(a - b)) <= max(_ALIKE * float(a.std()), rounding):
                raise BundleError(
                    f"{path.stem}: training seeds {first} and {second} played alike in the {len(common)} "
                    f"worlds that both finished: every seed must be a training of its own"
                )


def _copy_curves(agent: Agent, folder: Path) -> None:
    """Keep the learning curves: two columns, and few enough points for a chart."""
    for task in agent.tasks:
        for seed in agent.train_seeds(task):
            path = agent.folder / task / f"seed{seed}.curve.csv"
            if path.is_file() and path.stat().st_size <= _MOST_CURVE_BYTES:
                column = _column(path, agent.folder / task / f"seed{seed}.json")
                points = list(_points(path, column)) if column else []
                step = math.ceil(len(points) / CURVE_POINTS) or 1
                # the last point stays
                lines = [f"{steps:g},{value:.6g}\n" for steps, value in reversed(points[::-1][::step])]
                if len(lines) > 1:
                    write_text(
                        folder / "curves" / task / f"seed{seed}.csv", "steps,return\n" + "".join(lines)
                    )


def _column(curve: Path, record: Path) -> str | None:
    """The column of a curve whose returns are those that the task pays; None where there is none.

    Returns of periodic evaluations are. Those of training episodes are, unless the record says that
    training had reward weights of its own: such returns do not belong beside the task's reference.
    """
    if next(_points(curve, "eval_return"), None) is not None:
        return "eval_return"
    try:
        settings = read_json(record).get("settings") if record.is_file() else None
    except (SpecError, OSError):
        return None
    shaped = isinstance(settings, dict) and bool(cast(dict[str, Any], settings).get("weights"))
    return None if shaped else "return"


def _points(path: Path, column: str) -> Iterator[tuple[float, float]]:
    """The points of a learning curve that are numbers and go forward."""
    last = -1.0
    with path.open(encoding="utf-8", errors="replace", newline="") as lines, contextlib.suppress(csv.Error):
        for row in csv.DictReader(lines):
            try:
                steps, value = float(row["steps"]), float(row[column])
            except (KeyError, TypeError, ValueError):
                continue
            if last < steps <= _LARGEST and abs(value) <= _LARGEST:
                last = steps
                yield steps, value
