"""Many training runs from one file, one per core; a stopped sweep resumes.

A sweep file lists groups of runs::

    [[run]]
    tasks = ["hazard_nav-4", "hazard_nav-8"]
    algorithms = ["min_health", "central"]
    seeds = [0, 1, 2]
    preset = "recommended"        # or "paper"
    settings = { gamma = 0.95 }   # what differs from the preset
    label = "g95"                 # optional, part of the folders' names

Every combination is one run, in the folder ``<out>/<task>/<algorithm>[-<label>]/seed<k>``.
"""

from __future__ import annotations

import itertools
import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Literal, NamedTuple

import pydantic
import torch

from hipg_bench import launchers
from hipg_bench.documents import read_json, read_toml
from hipg_bench.errors import ResumeError, SpecError
from hipg_bench.launchers import Job, Launcher
from hipg_bench.learning.run import train
from hipg_bench.learning.settings import PRESETS, AnySettings
from hipg_bench.spec import Params, parse


class Group(Params):
    """Runs that share everything but task, algorithm and seed."""

    tasks: tuple[str, ...] = pydantic.Field(min_length=1)
    algorithms: tuple[str, ...] = ("min_health",)
    seeds: tuple[int, ...] = (0,)
    preset: Literal["recommended", "paper"] = "recommended"
    settings: dict[str, Any] = pydantic.Field(default_factory=dict[str, Any])
    label: str = pydantic.Field(default="", pattern=r"^[a-z0-9_]*$")


class Sweep(Params):
    """A sweep file."""

    run: tuple[Group, ...] = pydantic.Field(min_length=1)


class Run(NamedTuple):
    """One run of a sweep."""

    settings: AnySettings
    out: Path
    command: str
    algorithm: str
    """The settings' with the group's label: the folder's name."""

    @property
    def record(self) -> dict[str, Any] | None:
        """What is on disk: ``train.json``, or None before the first iteration's end.

        Raises:
            HipgError: the file is damaged.
        """
        path = self.out / "train.json"
        if not path.exists():
            return None
        record = read_json(path)
        try:
            steps, seconds = int(record["env_steps"]), float(record["seconds"])
        except (ValueError, KeyError, TypeError) as error:
            raise ResumeError(f"{path} is damaged: {error}") from error
        return {**record, "env_steps": steps, "seconds": seconds} if steps else None

    @property
    def done(self) -> int:
        """Environment steps that are on disk."""
        record = self.record
        return 0 if record is None else record["env_steps"]

    @property
    def finished(self) -> bool:
        """Whether nothing is left to do."""
        return self.done >= self.settings.steps


class Standing(NamedTuple):
    """How far a run is.

    Attributes:
        state: ``stopped`` is begun, and nothing was written for longer than ten iterations take.
        steps: environment steps that are done.
        seconds: that took.
        left: seconds it will yet take, at its own pace or at that of runs like it; None if none has begun.
    """

    run: Run
    state: Literal["waiting", "running", "stopped", "finished"]
    steps: int
    seconds: float
    left: float | None


def load(path: Path, out: Path) -> list[Run]:
    """Read a sweep file; the runs are those of its groups, seed by seed, so that early results cover all.

    Raises:
        SpecError: not readable, a field or setting that is not allowed, or two runs in one folder.
        UnknownNameError: no such task.
    """
    sweep = parse(Sweep, read_toml(path), str(path))
    runs = [run for group in sweep.run for run in _runs(group, out)]
    folders = [run.out for run in runs]
    if len(set(folders)) < len(folders):
        twice = next(folder for folder in folders if folders.count(folder) > 1)
        raise SpecError(f"{path}: two runs would share {twice}: give one of their groups a label")
    return sorted(runs, key=lambda run: run.settings.seed)


def shard(runs: list[Run], index: int, count: int) -> list[Run]:
    """Every ``count``-th run from ``index`` (from 0) on, so that as many drivers share a sweep."""
    return runs[index::count]


def work_off(runs: list[Run], engine: Launcher, report: Callable[[list[Run]], None]) -> None:
    """Train what is not finished.

    If this is interrupted, the trainings end too; the runs go on with the next call.

    Args:
        runs: of `load`.
        engine: where they are trained.
        report: called every few seconds with all runs.

    Raises:
        HipgError: what the first run raised that failed; the others end first.
    """
    by_folder = {run.out: run for run in runs}
    jobs = [Job(run.out, _train, (run.settings, run.out, run.command)) for run in runs]
    launchers.work_off(jobs, engine, lambda job: by_folder[job.folder].finished, lambda: report(runs))


def standings(runs: list[Run], now: float) -> list[Standing]:
    """How far the runs of a sweep are.

    Args:
        runs: of `load`.
        now: seconds since the epoch.
    """
    records = [run.record for run in runs]
    paces = [(run, one["seconds"] / one["env_steps"]) for run, one in zip(runs, records, strict=True) if one]
    return [_standing(run, one, paces, now) for run, one in zip(runs, records, strict=True)]


def _standing(
    run: Run, record: dict[str, Any] | None, paces: list[tuple[Run, float]], now: float
) -> Standing:
    if record is None:
        pace = _pace(run, paces)
        return Standing(run, "waiting", 0, 0.0, None if pace is None else pace * run.settings.steps)
    steps, seconds = record["env_steps"], record["seconds"]
    left = max(0, run.settings.steps - steps) * seconds / steps
    if left == 0:
        return Standing(run, "finished", steps, seconds, 0.0)
    patience = max(60.0, 10 * seconds / steps * run.settings.num_envs * run.settings.rollout)
    silent = now - (run.out / "train.json").stat().st_mtime
    return Standing(run, "stopped" if silent > patience else "running", steps, seconds, left)


def _pace(run: Run, paces: list[tuple[Run, float]]) -> float | None:
    """Seconds per step of the runs that are most like one that has not begun."""
    alike: tuple[Callable[[Run], bool], ...] = (
        lambda other: (other.settings.task, other.algorithm) == (run.settings.task, run.algorithm),
        lambda other: other.settings.task == run.settings.task,
        lambda other: True,
    )
    for like in alike:
        found = [pace for other, pace in paces if like(other)]
        if found:
            return sum(found) / len(found)
    return None


def _runs(group: Group, out: Path) -> Iterator[Run]:
    for task, algorithm, seed in itertools.product(group.tasks, group.algorithms, group.seeds):
        settings = PRESETS[group.preset](task, **{"algorithm": algorithm, "seed": seed, **group.settings})
        labelled = f"{algorithm}-{group.label}" if group.label else algorithm
        folder = out / task / labelled / f"seed{seed}"
        changed = [f"--set {name}={json.dumps(value)}" for name, value in group.settings.items()]
        options = [f"--task {task} --algorithm {algorithm} --preset {group.preset} --seed {seed}", *changed]
        yield Run(settings, folder, " ".join(["hipg-bench train", *options, f"--out {folder}"]), labelled)


def _train(settings: AnySettings, out: Path, command: str) -> None:
    torch.set_num_threads(1)
    train(settings, out, command=command, report=_stop_when_orphaned)


def _stop_when_orphaned(iteration: int, log: dict[str, float]) -> None:
    """See `launchers.stop_when_orphaned`."""
    launchers.stop_when_orphaned()
