"""How long it takes to score an agent."""

from __future__ import annotations

import dataclasses
import tempfile
import time
from pathlib import Path

from hipg_bench.evaluation.episodes import EvaluationJob
from hipg_bench.evaluation.runner import Suite, evaluate
from hipg_bench.policies.bundle import load_agent
from hipg_bench.spec import TaskSpec


@dataclasses.dataclass(frozen=True)
class Scoring:
    """Of one task, or of all of them together with statistics and the report.

    Attributes:
        agent, task, threads: what was run; the task is ``all`` in the last row.
        episodes: in all.
        seconds: they took.
        episodes_per_second: episodes / seconds.
        peak_mb: most memory of the process.
    """

    agent: str
    task: str
    threads: int
    episodes: int
    seconds: float
    episodes_per_second: float
    peak_mb: float | None = None


def scoring_time(agent: str, specs: tuple[TaskSpec, ...], episodes: int, threads: int) -> list[Scoring]:
    """Evaluate an agent without films.

    Args:
        agent: a bundle's name.
        specs: the tasks.
        episodes: per task and training seed.
        threads: physics threads, 0 for all cores.

    Raises:
        BundleError: no such agent, or it plays none of the tasks.
    """
    who = load_agent(agent)
    started = time.perf_counter()
    with tempfile.TemporaryDirectory(prefix="hipg-bench-") as folder:
        results = evaluate(
            who, Suite("bench", specs), Path(folder), EvaluationJob(episodes=episodes, threads=threads)
        )
    whole = time.perf_counter() - started
    played = {task["task"]: task["episodes"] for task in results["tasks"]}
    taken = [(task, count, results["timing"]["seconds"][task]) for task, count in played.items()]
    return [
        Scoring(agent, task, threads, count, seconds, count / seconds)
        for task, count, seconds in [*taken, ("all", sum(played.values()), whole)]
    ]
