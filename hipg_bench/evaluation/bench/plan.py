"""Which measurements a section of the bench is made of, and the document that holds what they found."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from hipg_bench.errors import RenderError
from hipg_bench.evaluation.bench import films
from hipg_bench.evaluation.bench.adapters import overheads
from hipg_bench.evaluation.bench.child import Job
from hipg_bench.evaluation.bench.machine import versions
from hipg_bench.evaluation.bench.scaling import over_agents, over_worlds
from hipg_bench.evaluation.bench.scoring import scoring_time
from hipg_bench.evaluation.bench.start import start_times
from hipg_bench.evaluation.bench.steps import reset_time, step_rate
from hipg_bench.policies.bundle import load_agent
from hipg_bench.processes import usable_cores
from hipg_bench.rendering import gl
from hipg_bench.spec import TaskSpec

SCHEMA = 1
_TEAM_SIZES = (2, 4, 8, 16, 31)
_AGENTS_AT = 256
"""Worlds in which the cost against the number of agents is measured."""
_ADAPTERS_AT = (1, 256)
_AGENT = "mappo_minhealth"


@dataclasses.dataclass(frozen=True)
class BenchmarkPlan:
    """What is to be measured.

    Attributes:
        specs: the tasks.
        num_envs: B, ascending.
        threads: physics threads; where one count is enough, the largest.
        seconds: per measurement.
        full: every family where a quick look takes one, and films of full size.
    """

    specs: tuple[TaskSpec, ...]
    num_envs: tuple[int, ...]
    threads: tuple[int, ...]
    seconds: float
    full: bool

    @property
    def examples(self) -> list[TaskSpec]:
        """The last task of every family, or of the first family only."""
        of_families = list({spec.family: spec for spec in self.specs}.values())
        return of_families if self.full else of_families[:1]


def make_plan(
    specs: Sequence[TaskSpec],
    *,
    num_envs: Sequence[int] = (),
    threads: Sequence[int] = (),
    seconds: float | None = None,
    full: bool = False,
) -> BenchmarkPlan:
    """A request with everything that was left open filled in, threads 0 replaced by all cores."""
    cores = usable_cores()
    powers = [2**k for k in range(cores.bit_length()) if 2**k < cores]
    return BenchmarkPlan(
        specs=tuple(specs),
        num_envs=tuple(sorted(num_envs or ((1, 64, 1024, 4096) if full else (1, 64, 1024)))),
        threads=tuple(
            sorted({count or cores for count in threads or ((*powers, cores) if full else (cores,))})
        ),
        seconds=seconds or (3.0 if full else 1.0),
        full=full,
    )


def document(
    asked: BenchmarkPlan, sections: Mapping[str, list[Any]], host: dict[str, Any], seconds: float
) -> dict[str, Any]:
    """Everything for a script: rows by section, the machine as it was before, and how long it all took."""
    return {
        "schema": SCHEMA,
        "machine": host,
        "versions": versions(),
        "settings": {
            **dataclasses.asdict(asked),
            "specs": {spec.task: spec.fingerprint for spec in asked.specs},
        },
        "seconds": round(seconds, 1),
        "sections": {name: [dataclasses.asdict(row) for row in rows] for name, rows in sections.items()},
    }


def _steps(asked: BenchmarkPlan) -> list[Job]:
    return [
        Job("steps", step_rate, (spec, size, count, asked.seconds))
        for spec in asked.specs for count in asked.threads for size in asked.num_envs
    ]  # fmt: skip


def _reset(asked: BenchmarkPlan) -> list[Job]:
    specs = asked.specs if asked.full else {spec.family: spec for spec in asked.specs}.values()
    sizes = sorted({asked.num_envs[0], asked.num_envs[-1]})
    return [
        Job("reset", reset_time, (spec, size, asked.threads[-1], asked.seconds))
        for spec in specs for size in sizes
    ]  # fmt: skip


def _render(asked: BenchmarkPlan) -> list[Job]:
    backend = gl.working_backend()
    if backend is None:
        raise RenderError(f"no OpenGL works here, so nothing can be rendered: run\n  {gl.INSTALL_COMMAND}")
    size, frames = ((1280, 720), 60) if asked.full else ((640, 360), 20)
    variables = gl.environment(backend)
    return [
        Job("render", films.film_time, (spec, size, backend, frames, 3), variables) for spec in asked.examples
    ]


def _evaluate(asked: BenchmarkPlan) -> list[Job]:
    agent = load_agent(_AGENT)
    specs = tuple(spec for spec in asked.specs if agent.train_seeds(spec.task))
    episodes = 320 if asked.full else 32
    return [Job("evaluate", scoring_time, (_AGENT, specs, episodes, asked.threads[-1]))] if specs else []


def _start(asked: BenchmarkPlan) -> list[Job]:
    return [Job("start", start_times, (asked.seconds,))]


def _adapters(asked: BenchmarkPlan) -> list[Job]:
    return [
        Job("adapters", overheads, (spec, size, 1 if size == 1 else asked.threads[-1], asked.seconds))
        for spec in asked.examples for size in _ADAPTERS_AT
    ]  # fmt: skip


def _scaling(asked: BenchmarkPlan) -> list[Job]:
    count, top = asked.threads[-1], asked.num_envs[-1]
    sizes = [4**k for k in range(top.bit_length()) if 4**k <= top]
    seconds = 2 * asked.seconds
    return [
        job
        for spec in asked.examples
        for job in (
            Job("scaling", over_agents, (spec, _TEAM_SIZES, min(top, _AGENTS_AT), count, seconds)),
            Job("scaling", over_worlds, (spec, sizes, count, seconds)),
        )
    ]


SECTIONS: Mapping[str, Callable[[BenchmarkPlan], list[Job]]] = {
    "steps": _steps, "reset": _reset, "render": _render, "evaluate": _evaluate, "start": _start,
    "adapters": _adapters, "scaling": _scaling,
}  # fmt: skip
"""Name to the jobs that a request means; training is measured by `hipg_bench.learning.bench`."""
