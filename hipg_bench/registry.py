"""Tasks by name: ``tasks/*.toml`` holds the numbers, `FAMILIES` the rules."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from typing import Any

from hipg_bench import spec as specs
from hipg_bench.arguments import seed_or_entropy, whole
from hipg_bench.env import BatchEnv
from hipg_bench.errors import SpecError, UnknownNameError, hint
from hipg_bench.families.family import Family
from hipg_bench.families.hazard_comm import HazardComm
from hipg_bench.families.hazard_nav import HazardNav
from hipg_bench.families.multiwalker import MultiWalker
from hipg_bench.families.paper_comm import PaperComm
from hipg_bench.families.paper_nav import PaperNav
from hipg_bench.paths import data_folder
from hipg_bench.spec import TaskSpec

FAMILIES: dict[str, Callable[[TaskSpec], Family]] = {
    "hazard_nav": HazardNav,
    "hazard_comm": HazardComm,
    "multiwalker": MultiWalker,
    "paper_nav": PaperNav,
    "paper_comm": PaperComm,
}
"""Name in a task file to the class with its rules; one of your own is added here."""


_MOST_THREADS = 1024


@functools.cache
def tasks() -> Mapping[str, TaskSpec]:
    """All task specs by name."""
    files = sorted(data_folder("tasks").glob("*.toml"))
    return {path.stem: specs.load(path) for path in files}


def task_spec(task: str) -> TaskSpec:
    """Return one task's spec.

    Raises:
        UnknownNameError: no such task; the message holds the nearest name.
    """
    if task not in tasks():
        raise UnknownNameError(f"no task {task!r}{hint(task, tasks())}")
    return tasks()[task]


def tagged(tag: str) -> tuple[str, ...]:
    """Names of the tasks that carry a tag."""
    return tuple(name for name, spec in tasks().items() if tag in spec.tags)


def family_of(spec: TaskSpec) -> Family:
    """Build the rules for a spec.

    Raises:
        SpecError: unknown family, or a number of the family that is not allowed.
    """
    if spec.family not in FAMILIES:
        raise SpecError(f"{spec.task}: no family {spec.family!r}{hint(spec.family, FAMILIES)}")
    return FAMILIES[spec.family](spec)


def make(
    task: str | TaskSpec,
    num_envs: int = 1,
    seed: int | None = 0,
    *,
    threads: int = 0,
    autoreset: bool = True,
    **overrides: Any,
) -> BatchEnv:
    """Build B worlds of a task.

    Args:
        task: a name, or a spec of your own.
        num_envs: B >= 1.
        seed: in 0..2^64 - 1; with the episode id it fixes all chance. None draws one.
        threads: physics threads; 0 for all cores that this process may use. Results do not depend on it.
        autoreset: a world whose episode ends starts the next in the same step; else it waits for ``reset``.
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
    return BatchEnv(spec, family_of(spec), num_envs, seed, threads=threads, autoreset=autoreset)
