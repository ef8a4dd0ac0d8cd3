"""Tasks by name: ``tasks/*.toml`` holds the numbers, `hipg_bench.families` the rules."""

from __future__ import annotations

import functools
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from hipg_bench import spec as specs
from hipg_bench.arguments import seed_or_entropy, whole
from hipg_bench.env import BatchEnv
from hipg_bench.errors import SpecError, UnknownNameError, hint
from hipg_bench.families.known import definition_of, import_plugins, register_family
from hipg_bench.paths import data_folder
from hipg_bench.spec import TaskSpec

_MOST_THREADS = 1024


@functools.cache
def tasks() -> Mapping[str, TaskSpec]:
    """All task specs by name."""
    files = sorted(data_folder("tasks").glob("*.toml"))
    return {path.stem: specs.load(path) for path in files}


_added: dict[str, TaskSpec] = {}
"""Tasks that this process was given beside those of the benchmark, by name."""


def task_spec(task: str) -> TaskSpec:
    """Return the spec of a task of the benchmark, or of one that `add_task` was given.

    Raises:
        UnknownNameError: no such task; the message holds the nearest name.
    """
    if task not in tasks() and task not in _added:
        import_plugins()  # they may add tasks
    known = tasks() if task in tasks() else _added
    if task not in known:
        raise UnknownNameError(f"no task {task!r}{hint(task, [*tasks(), *_added])}")
    return known[task]


def add_task(spec: TaskSpec) -> TaskSpec:
    """Make a task known by its name to all functions of this process that take a name.

    Raises:
        SpecError: another task has this name, or a number of the family is not allowed.
    """
    definition_of(spec)
    known = tasks().get(spec.task) or _added.get(spec.task)
    if known is not None and known.fingerprint != spec.fingerprint:
        raise SpecError(f"{spec.task}: there is another task of this name: choose a different one")
    if spec.task not in tasks():
        _added[spec.task] = spec
    return spec


def read_task(path: str | Path) -> TaskSpec:
    """Read a task file of your own; its name is known in this process from then on.

    Raises:
        SpecError: the file does not hold a valid task, or another task has its name.
        OSError: it cannot be read.
    """
    return add_task(specs.load(Path(path)))


def vary(spec: TaskSpec, **changes: Any) -> TaskSpec:
    """A task with some numbers changed, under a name of its own that tells them.

    Args:
        spec: the task.
        **changes: as `TaskSpec.override` takes them.

    Returns:
        The changed task, known in this process from then on; ``spec`` itself where nothing changes. It has
        no anchors: its scores are not those of the task that it was made from.

    Raises:
        SpecError: a change that is not allowed.
    """
    changed = spec.override(**changes)
    if changed.fingerprint == spec.fingerprint:
        return spec
    told = "_".join(f"{name}-{_slug(value)}" for name, value in sorted(changes.items()))
    name = f"{spec.task}_{told}"
    if len(name) > _LONGEST_NAME:
        name = f"{spec.task}_{changed.fingerprint}"
    return add_task(changed.model_copy(update={"task": name, "tags": ()}))


_LONGEST_NAME = 64


def _slug(value: Any) -> str:
    """A value as a part of a task's name, which is also a file's."""
    return re.sub(r"[^a-z0-9]+", "-", str(value).lower().replace("-", "minus")).strip("-")


def tagged(tag: str) -> tuple[str, ...]:
    """Names of the tasks that carry a tag."""
    return tuple(name for name, spec in tasks().items() if tag in spec.tags)


def make(
    task: str | TaskSpec,
    num_envs: int = 1,
    seed: int | None = 0,
    *,
    threads: int = 0,
    autoreset: bool = True,
    compiled: bool = True,
    **overrides: Any,
) -> BatchEnv:
    """Build B worlds of a task.

    Args:
        task: a name, or a spec of your own.
        num_envs: B >= 1.
        seed: in 0..2^64 - 1; with the episode id it fixes all chance. None draws one.
        threads: physics threads; 0 for all cores that this process may use. Results do not depend on it.
        autoreset: a world whose episode ends starts the next in the same step; else it waits for ``reset``.
        compiled: off to run the rules as Python, a thousand times slower, with bounds checked.
        **overrides: spec fields (``num_agents``, ``horizon``, ...), family numbers, or ``weights``.

    Raises:
        UnknownNameError: no such task.
        SpecError: an override, ``num_envs``, ``seed`` or ``threads`` that is not allowed.
    """
    spec = task_spec(task) if isinstance(task, str) else task
    if overrides:
        spec = spec.override(**overrides)
    num_envs = whole(num_envs, f"{spec.task}: num_envs", 1)
    threads = whole(threads, f"{spec.task}: threads", 0, _MOST_THREADS)
    seed = seed_or_entropy(seed, f"{spec.task}: seed")
    return BatchEnv(
        definition_of(spec), num_envs, seed, threads=threads, autoreset=autoreset, compiled=compiled
    )


__all__ = [
    "add_task", "definition_of", "make", "read_task", "register_family", "tagged", "task_spec", "tasks",
]  # fmt: skip
