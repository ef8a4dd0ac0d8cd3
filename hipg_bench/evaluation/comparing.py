"""Two evaluations side by side, world by world."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pydantic

from hipg_bench import registry
from hipg_bench.documents import read_json
from hipg_bench.errors import HipgError
from hipg_bench.evaluation.episodes import Row
from hipg_bench.evaluation.results import SCHEMA, aggregate
from hipg_bench.evaluation.rows import read_rows
from hipg_bench.evaluation.statistics import Interval, paired_difference
from hipg_bench.paths import check_seal
from hipg_bench.registry import task_spec
from hipg_bench.spec import Anchors, TaskSpec, parse

_SAME = ("split", "seed", "commitment", "episodes_per_policy")
"""What two evaluations must share, so that they met the same worlds."""


class _Document(pydantic.BaseModel):
    model_config = pydantic.ConfigDict(extra="ignore", allow_inf_nan=False)


class _Run(_Document):
    train_seed: int
    score: float | None


class _Task(_Document):
    task: str
    fingerprint: str
    score: float | None
    runs: tuple[_Run, ...] = pydantic.Field(min_length=1)


class _Aggregate(_Document):
    scored: tuple[str, ...]
    score_iqm: float | None
    score_iqm_ci95: tuple[float, float] | None


class _Results(_Document):
    """What comparisons need of ``results.json``; the rest is in ``docs/concepts/protocol.md``."""

    schema_: Literal[2] = pydantic.Field(alias="schema")
    suite: str
    split: str
    agent: str
    kind: Literal["method", "checkpoint", "reference"]
    aggregate: _Aggregate
    tasks: tuple[_Task, ...]
    own_tasks: dict[str, dict[str, Any]] = {}


def read(folder: Path) -> dict[str, Any]:
    """What ``results.json`` of a finished evaluation holds.

    Tasks in it that are none of the benchmark's are known in this process from then on.

    Raises:
        HipgError: there is none, it is damaged, or of another schema, or another task has the name of one of
            its own.
    """
    path = folder / "results.json"
    if not path.is_file():
        raise HipgError(f"{folder} holds no results.json: it is not a finished evaluation")
    results = read_json(path)
    if results.get("schema") != SCHEMA:
        raise HipgError(f"{path}: schema {SCHEMA} is allowed, got {results.get('schema')}: evaluate again")
    parse(_Results, results, str(path))
    for task, spec in results.get("own_tasks", {}).items():
        registry.add_task(parse(TaskSpec, spec, f"{path}: own_tasks.{task}"))
    return results


def on_common_tasks(evaluations: Mapping[str, Path]) -> dict[str, dict[str, Any]]:
    """Results of several evaluations, each summed up over the scored tasks that all of them played.

    Args:
        evaluations: name to folder.

    Returns:
        Name to what ``results.json`` holds, with ``aggregate`` and ``tasks`` of those tasks alone.

    Raises:
        HipgError: there is no such task, or one of them is no evaluation.
    """
    found = {name: read(folder) for name, folder in evaluations.items()}
    scored = [
        {task["task"]: task["fingerprint"] for task in results["tasks"] if task["score"] is not None}
        for results in found.values()
    ]
    common = [
        task
        for task, fingerprint in scored[0].items()
        if all(other.get(task) == fingerprint for other in scored)
    ]
    if not common:
        raise HipgError(f"no scored task was played by all of {', '.join(evaluations)}, in the same version")
    for name, folder in evaluations.items():
        results = found[name]
        tasks = {task["task"]: task for task in results["tasks"]}
        whole = [tasks[task] for task in common]
        played = [
            (_anchored(task_spec(task["task"]), task["anchors"]), rows_of(folder, task["task"]))
            for task in whole
        ]
        found[name] = results | {"suite": "common", "tasks": whole, "aggregate": aggregate(played)}
    return found


def _anchored(spec: TaskSpec, anchors: Mapping[str, Any]) -> TaskSpec:
    """The task on the scale that an evaluation used."""
    return spec.model_copy(update={"anchors": parse(Anchors, dict(anchors), spec.task)})


def rows_of(folder: Path, task: str) -> list[Row]:
    """The rows of a task of an evaluation.

    Raises:
        HipgError: they are missing or damaged.
    """
    spec = task_spec(task)  # a name of ours, before it becomes part of a path
    path = folder / "episodes" / f"{task}.jsonl"
    check_seal(path)
    return read_rows(path.read_bytes(), str(path), spec)


def differences(ours: Path, theirs: Path) -> Mapping[str, tuple[float, Interval]]:
    """By how much our score is above theirs in the same worlds, with a 95 % interval, per task both played.

    Raises:
        HipgError: they did not meet the same worlds, or one of them is no evaluation.
    """
    a, b = read(ours), read(theirs)
    for name in _SAME:
        if a.get(name) != b.get(name):
            raise HipgError(
                f"{ours} and {theirs} are of other worlds: {name} is {a.get(name)} and {b.get(name)}"
            )
    played = {task["task"]: task for task in b["tasks"]}
    found: dict[str, tuple[float, Interval]] = {}
    for task in a["tasks"]:
        name = task["task"]
        if name in played and task["score"] is not None:
            if task["fingerprint"] != played[name]["fingerprint"]:
                raise HipgError(f"{ours} and {theirs} are of other versions of {name}")
            sides = _scores(ours, name), _scores(theirs, name)
            if sides[0].shape[1] != sides[1].shape[1]:
                raise HipgError(
                    f"{name}: {ours} has rows of {sides[0].shape[1]} worlds and {theirs} of "
                    f"{sides[1].shape[1]}: finish the shorter evaluation"
                )
            found[name] = paired_difference(*sides)
    return found


def _scores(folder: Path, task: str) -> np.ndarray:
    """Score of every training run (first axis) in every world."""
    rows = rows_of(folder, task)
    runs = len({row["train_seed"] for row in rows})
    # rows are in the order of training seeds, then worlds
    if len(rows) % runs or any(row["score"] is None for row in rows):
        raise HipgError(f"{folder}: {task}: a training seed has no score in some worlds: finish it first")
    return np.array([row["score"] for row in rows]).reshape(runs, -1)
