"""How the cost of a step grows with the number of agents, and falls with the number of worlds."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

from hipg_bench.evaluation.bench.steps import stepping
from hipg_bench.evaluation.bench.timing import Contender, in_turn
from hipg_bench.spec import TaskSpec

_OFTEN = 64
"""Steps of one world while the largest batch does one, at most."""


@dataclasses.dataclass(frozen=True)
class Cost:
    """One point of a sweep.

    Attributes:
        task: of which the sweep is.
        sweep: ``agents`` or ``worlds``, what is varied.
        num_agents, num_envs, threads: what was run.
        step_us: time per control step of one world.
        growth: the same over that of the sweep's first point, the median of the rounds' own ratios.
        growth_per_agent: growth over that of the number of agents; at most 1 is no worse than linear.
    """

    task: str
    sweep: str
    num_agents: int
    num_envs: int
    threads: int
    step_us: float
    growth: float
    growth_per_agent: float


def over_agents(
    spec: TaskSpec, team_sizes: Sequence[int], num_envs: int, threads: int, seconds: float
) -> list[Cost]:
    """Time teams of several sizes in turn, all else as the task has it.

    Args:
        spec: the task.
        team_sizes: N, ascending.
        num_envs: B.
        threads: physics threads, 0 for all cores.
        seconds: for all together.
    """
    points = {(size, num_envs): spec.override(num_agents=size) for size in team_sizes}
    return _sweep("agents", points, threads, seconds)


def over_worlds(spec: TaskSpec, num_envs: Sequence[int], threads: int, seconds: float) -> list[Cost]:
    """Time batches of several sizes in turn; arguments as of `over_agents`, B ascending."""
    return _sweep("worlds", {(spec.num_agents, size): spec for size in num_envs}, threads, seconds)


def _sweep(
    sweep: str, points: Mapping[tuple[int, int], TaskSpec], threads: int, seconds: float
) -> list[Cost]:
    """Time every point (N, B) in turn with the others."""
    most = max(num_envs for _, num_envs in points)
    # small batches step more often, so that a turn is long enough to be timed
    often = {point: min(most // point[1], _OFTEN) for point in points}
    contenders = {
        _name(point): _repeated(stepping(spec, point[1], threads)[1], often[point])
        for point, spec in points.items()
    }
    times = in_turn(contenders, seconds)
    base = min(points)
    out: list[Cost] = []
    for point, spec in points.items():
        size, num_envs = point
        steps, base_steps = often[point] * num_envs, often[base] * base[1]
        growth = times.ratio(_name(point), _name(base)) * base_steps / steps
        out.append(
            Cost(
                spec.task, sweep, size, num_envs, threads,
                step_us=1e6 * times.median(_name(point)) / steps,
                growth=growth,
                growth_per_agent=growth * base[0] / size,
            )
        )  # fmt: skip
    return out


def _name(point: tuple[int, int]) -> str:
    return f"{point[0]} agents, {point[1]} worlds"


def _repeated(step: Contender, count: int) -> Contender:
    """Several calls as one."""

    def call() -> None:
        for _ in range(count):
            step.call()

    return Contender(call)
