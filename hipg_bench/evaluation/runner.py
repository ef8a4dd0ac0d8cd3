"""`evaluate`: an agent plays a suite; rows, results, films and a report come to lie in one folder.

    run.json                 what the folder belongs to
    episodes/<task>.jsonl    one row per episode: the product, byte for byte reproducible
    films/<task>.npz         state rows of the filmed episodes
    videos/<task>.mp4        the median episode
    results.json             everything computed from the rows
    report.html              the same to look at

An interrupted evaluation goes on where it stopped, and ends with the same rows.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import math
import shutil
import time
from collections.abc import Callable, Generator, Mapping, Sequence
from pathlib import Path
from typing import Any

from hipg_bench import registry
from hipg_bench.claims import HeldError
from hipg_bench.documents import read_json
from hipg_bench.errors import BundleError, ResumeError, SpecError, UnknownNameError
from hipg_bench.evaluation import blocks, films, protocol, report, splits
from hipg_bench.evaluation.blocks import Block
from hipg_bench.evaluation.episodes import EvaluationJob, Row, versions
from hipg_bench.evaluation.failures import NOT_PLAYED, close
from hipg_bench.evaluation.latency import Stopwatch
from hipg_bench.evaluation.ranking import kind_of
from hipg_bench.evaluation.results import SCHEMA, aggregate, summarise
from hipg_bench.evaluation.rows import read_rows
from hipg_bench.evaluation.seeds import WORLDS_PER_SEED, commitment
from hipg_bench.paths import check_seal, output_folder, remove_partial, write_text
from hipg_bench.policies.bundle import Agent
from hipg_bench.spec import TaskSpec

Progress = Callable[[str, float], None]
"""Told a task (or ``films``) and how many more of its episodes (or films) are done."""


_PATIENCE = 60.0
"""Seconds that another process has to begin an evaluation that is shared."""
_FOLDERS = ("episodes", "films", "videos")
_RESULTS = ("results.json", "report.html", "films", "videos")
"""What an evaluation may overwrite; rows in ``episodes`` are read and gone on with."""


@dataclasses.dataclass(frozen=True)
class Suite:
    """The tasks to play, and what to call the lot."""

    name: str
    specs: tuple[TaskSpec, ...]


def quiet(stage: str, done: float) -> None:
    """Tell nobody."""


Report = Callable[[dict[str, Any]], None]
"""Told what ``results.json`` says of a task, or all of it."""


def unheard(results: dict[str, Any]) -> None:
    """Tell nobody."""


def playable(
    agent: Agent, suite: Suite, split: str = splits.STANDARD
) -> tuple[dict[str, tuple[int, ...]], dict[str, str]]:
    """Training seeds per task that the agent plays, and the reason per task that it does not.

    Raises:
        BundleError: it plays none of them.
    """
    seeds: dict[str, tuple[int, ...]] = {}
    skipped: dict[str, str] = {}
    for spec in suite.specs:
        found = agent.train_seeds(spec.task)
        if not found:
            skipped[spec.task] = f"no {'weights' if agent.card.kind == 'network' else 'policy'} for this task"
            continue
        try:
            splits.split_config(split, spec).background_policy(spec)
            agent.check_distinct(spec.task)
            for train_seed in found:
                close(agent.policy(spec, train_seed))
            seeds[spec.task] = found
        except (BundleError, UnknownNameError) as error:
            skipped[spec.task] = str(error)
    if not seeds:
        raise BundleError(
            f"agent {agent.name!r} plays none of these tasks:\n"
            + "\n".join(f"  {task}: {reason}" for task, reason in skipped.items())
        )
    return seeds, skipped


def evaluate(
    agent: Agent,
    suite: Suite,
    out: Path,
    job: EvaluationJob,
    *,
    films_per_task: int = 0,
    progress: Progress = quiet,
    played_task: Report = unheard,
    scored: Report = unheard,
) -> dict[str, Any]:
    """Score an agent.

    Args:
        agent: who plays.
        suite: what.
        out: folder, new or of the same evaluation interrupted earlier.
        job: which worlds.
        films_per_task: how many episodes are filmed; the first is the median one.
        progress: told how far it is.
        played_task: told the entry of ``tasks`` in ``results.json`` as soon as a task is played.
        scored: told all results before the films are begun. They and the report are on disk by then, and stay
            if the films are interrupted, together with those that were finished.

    Returns:
        What ``results.json`` holds.

    Raises:
        BundleError: the agent plays none of the tasks.
        ResumeError: ``out`` belongs to another evaluation or is used by another process, holds files of
            somebody's that would be overwritten, or is damaged.
    """
    seeds, skipped = playable(agent, suite, job.split)
    specs = [splits.with_anchors(job.split, spec) for spec in suite.specs]
    worlds = _which_worlds(job)
    with _alone_in(out, _record(agent, job)):
        seconds: dict[str, float] = {}
        watches: dict[str, Stopwatch] = {}
        rows: dict[str, list[Row]] = {}
        for spec in specs:
            if spec.task in seeds:
                watches[spec.task] = watch = Stopwatch()
                with _timed(seconds, spec.task):
                    rows[spec.task] = _play_task(agent, spec, seeds[spec.task], out, job, watch, progress)
                played_task(summarise(spec, rows[spec.task]))
        played = [spec for spec in specs if spec.task in rows]
        own = [spec for spec in played if spec.task not in registry.tasks()]
        results: dict[str, Any] = {
            "schema": SCHEMA,
            "suite": suite.name,
            "split": job.split,
            "protocol": protocol.identity(),
            "agent": agent.name,
            "kind": kind_of(agent.card.kind == "builtin", [len(found) for found in seeds.values()]),
            "agent_summary": agent.summary,
            "seed": None,
            "commitment": None,
            **worlds,
            "episodes_per_policy": job.episodes,
            "versions": versions(),
            "aggregate": aggregate([(spec, rows.get(spec.task, [])) for spec in specs]),
            "tasks": [summarise(spec, rows[spec.task]) for spec in played],
            "skipped": [{"task": task, "reason": reason} for task, reason in skipped.items()],
            "films": [],
            "film_trouble": [],
            "timing": {
                "seconds": seconds,
                "act_ms": {task: watch.summary() for task, watch in watches.items()},
            },
        }
        if own:
            results["own_tasks"] = {spec.task: spec.model_dump(mode="json") for spec in own}

        def write() -> None:
            write_text(out / "results.json", json.dumps(results, indent=2, allow_nan=False) + "\n")
            page = report.render(results, rows, {spec.task: spec for spec in played})
            write_text(out / "report.html", page)

        write()
        shutil.rmtree(out / blocks.FOLDER, ignore_errors=True)  # their rows are in ``episodes``
        scored(results)
        if films_per_task:
            try:
                with _timed(seconds, "films"):
                    _film(agent, played, rows, job, films_per_task, out, results, progress)
            finally:
                write()
        return results


def prepare(agent: Agent, name: str, suite: Suite, out: Path, job: EvaluationJob) -> list[Block]:
    """Begin or join an evaluation that many processes share; return the blocks to be played.

    Args:
        agent: who plays.
        name: its name or path, from which other processes load it.
        suite: what.
        out: folder, new or of the same evaluation.
        job: which worlds.

    Raises:
        BundleError: the agent plays none of the tasks.
        ResumeError: as `evaluate` says.
    """
    if job.salt is not None:
        raise SpecError("hidden worlds are played in one process: the salt is told to no other")
    seeds, _ = playable(agent, suite, job.split)
    run, out = _record(agent, job), out.resolve()
    until = time.monotonic() + _PATIENCE
    while True:
        _check_belongs(out, run)
        if (out / blocks.RECORD).exists():
            break
        try:
            with _alone_in(out, run):
                pass
        except HeldError:  # another process begins it
            if time.monotonic() > until:
                raise
            time.sleep(0.1)
    specs = [splits.with_anchors(job.split, spec) for spec in suite.specs]
    found = [
        Block(name, spec, identity, number, out, job, run)
        for spec in specs
        for identity in _identities(agent, spec, seeds.get(spec.task, ())).values()
        for number in range(math.ceil(job.episodes / WORLDS_PER_SEED))
    ]
    return sorted(found, key=lambda block: block.number)


def _record(agent: Agent, job: EvaluationJob) -> dict[str, Any]:
    """What ``run.json`` says of an evaluation."""
    suite = protocol.identity()
    return {
        "agent": agent.name,
        "split": job.split,
        **_which_worlds(job),
        "versions": versions(),
        "suite": f"{suite['suite']} {suite['digest']}",
    }


def _which_worlds(job: EvaluationJob) -> dict[str, Any]:
    return {"seed": job.seed} if job.salt is None else {"commitment": commitment(job.salt)}


def _film(
    agent: Agent,
    specs: Sequence[TaskSpec],
    rows: Mapping[str, Sequence[Row]],
    job: EvaluationJob,
    count: int,
    out: Path,
    results: dict[str, Any],
    progress: Progress,
) -> None:
    """Make the films and enter them in the results; those that are finished, where it is interrupted."""
    chosen, trouble = films.choose_all(agent, specs, rows, job, count, out)
    results["film_trouble"] = [*trouble, "interrupted"]
    try:
        results["film_trouble"] = [*trouble, *films.make(chosen, lambda done: progress("films", done))]
    finally:
        results["films"] = [
            {"task": one.spec.task, "file": one.file, "title": one.title}
            for one in chosen
            if one.video.exists()
        ]


@contextlib.contextmanager
def _timed(seconds: dict[str, float], name: str) -> Generator[None]:
    """Note how long a block took, also one that is interrupted."""
    started = time.perf_counter()
    try:
        yield
    finally:
        seconds[name] = round(time.perf_counter() - started, 3)


def _play_task(
    agent: Agent,
    spec: TaskSpec,
    train_seeds: Sequence[int],
    out: Path,
    job: EvaluationJob,
    watch: Stopwatch,
    progress: Progress,
) -> list[Row]:
    """Play what is missing of one task; the file is whole after every batch."""
    path = out / "episodes" / f"{spec.task}.jsonl"
    identity = _identities(agent, spec, train_seeds)
    rows = {(row["train_seed"], row["world"]): row for row in _resumed(path, spec, identity, job)}
    for train_seed, played in _of_blocks(out, spec, identity, job).items():
        known = {world: row for (seed, world), row in rows.items() if seed == train_seed}
        known = {row["world"]: row for row in played} | known
        policy = agent.policy(spec, train_seed)
        for row in blocks.cut_after_dnf(spec, policy, list(known.values()), job):
            rows[train_seed, row["world"]] = row
    if rows:
        _write_rows(path, rows)
    progress(spec.task, len(rows))
    for train_seed in train_seeds:
        policy = watch.timed(agent.policy(spec, train_seed))
        done = [row for (seed, _), row in rows.items() if seed == train_seed]
        for played in job.rows(spec, policy, done, lambda more: progress(spec.task, more)):
            rows |= {(train_seed, row["world"]): identity[train_seed] | row for row in played}
            _write_rows(path, rows)
    return [rows[key] for key in sorted(rows)]


def _identities(agent: Agent, spec: TaskSpec, train_seeds: Sequence[int]) -> dict[int, Row]:
    """What rows say of the task, the policy of each training seed and the versions."""
    return {
        k: {
            "task": spec.task, "version": spec.version, "fingerprint": spec.fingerprint, "agent": agent.name,
            "policy": agent.fingerprint(spec.task, k), "train_seed": k, "versions": versions(),
        }
        for k in train_seeds
    }  # fmt: skip


def _of_blocks(
    out: Path, spec: TaskSpec, identity: Mapping[int, Row], job: EvaluationJob
) -> dict[int, list[Row]]:
    """Rows of blocks, by training seed.

    Raises:
        ResumeError: they are of another evaluation, or damaged.
    """
    found: dict[int, list[Row]] = {}
    run = read_json(out / blocks.RECORD)
    for path in sorted((out / blocks.FOLDER).glob(f"{spec.task}-seed*/{blocks.ROWS}")):
        blocks.check_record(path.with_name(blocks.RECORD), run)
        for row in _resumed(path, spec, identity, job):
            found.setdefault(row["train_seed"], []).append(row)
    return found


def _write_rows(path: Path, rows: Mapping[tuple[int, int], Row]) -> None:
    write_text(
        path, "".join(json.dumps(rows[key], allow_nan=False) + "\n" for key in sorted(rows)), sealed=True
    )


def _resumed(path: Path, spec: TaskSpec, identity: Mapping[int, Row], job: EvaluationJob) -> list[Row]:
    """Rows of an earlier, interrupted call.

    Raises:
        ResumeError: they are another agent's, task's or job's, or damaged.
    """
    if not path.exists():
        return []
    check_seal(path)
    try:
        rows = read_rows(path.read_bytes(), str(path), spec)
    except SpecError as error:
        raise ResumeError(
            f"{error}; choose another --out, or remove the file to play the task again"
        ) from error
    for row in rows:
        expected = identity.get(row["train_seed"])
        if expected is None:
            raise blocks.foreign(path, "train_seed", row["train_seed"], list(identity))
        seed = job.told_seed(row["task"], row["world"])
        expected = expected | {"eval_seed": seed, "split": job.split}
        for name, value in expected.items():
            if row[name] != value:
                raise blocks.foreign(path, name, row[name], value)
        if row["world"] >= job.episodes:
            raise blocks.foreign(path, "world", row["world"], f"below {job.episodes}")
    # a longer evaluation may still be finished
    return [row for row in rows if row["status"] != NOT_PLAYED]


@contextlib.contextmanager
def _alone_in(out: Path, run: Mapping[str, Any]) -> Generator[None]:
    """Hold the folder of an evaluation, new or interrupted earlier.

    Raises:
        ResumeError: as `evaluate` says.
    """
    _check_belongs(out, run)
    with output_folder(out, blocks.RECORD, _RESULTS, "evaluating"):
        _check_belongs(out, run)
        for folder in (out, *(out / name for name in _FOLDERS)):
            remove_partial(folder)
        write_text(out / blocks.RECORD, json.dumps(run, indent=2) + "\n")
        yield


def _check_belongs(out: Path, run: Mapping[str, Any]) -> None:
    """See that a folder is of this evaluation or of none; nothing in it is changed.

    Raises:
        ResumeError: it belongs to another evaluation, or ``run.json`` is damaged.
    """
    if (out / blocks.RECORD).exists():
        blocks.check_record(out / blocks.RECORD, run)
