"""What the bundles say of each training run: how it learned, and what it reached."""

from __future__ import annotations

import csv
import dataclasses
import re
from pathlib import Path

import numpy as np
from jaxtyping import Float

from hipg_bench.comparison.artefacts import BUNDLES
from hipg_bench.documents import read_json
from hipg_bench.registry import tasks
from hipg_bench.spec import TaskSpec

_BLOCKS = 30
"""Points of a drawn curve at most; each is a mean over neighbours, as in the paper."""
_END = 0.1
"""Share of a run whose mean stands for what it reached, where no score was measured."""


@dataclasses.dataclass(frozen=True)
class Trace:
    """A training run.

    Attributes:
        algorithm: min_health, central, ..., with ``-<label>`` for a variant.
        task: its name.
        seed: of the training.
        steps: (K,) environment steps, rising.
        score: (K,) there, 0 as random actions and 1 as the reference.
        evaluated: scores are of periodic evaluations without exploration; else of the training's own
            episodes.
        warm: it began with another run's policy.
        final: score of the last policy by the standard protocol; else the mean of the last tenth.
    """

    algorithm: str
    task: str
    seed: int
    steps: Float[np.ndarray, "K"]
    score: Float[np.ndarray, "K"]
    evaluated: bool
    warm: bool
    final: float

    def between(self, start: float, end: float) -> float:
        """Mean score from one share of the run's steps to another; NaN where there is no point."""
        share = self.steps / self.steps[-1]
        inside = self.score[(share > start) & (share <= end)]
        return float(inside.mean()) if len(inside) else float("nan")


def traces(agents: Path) -> list[Trace]:
    """Read all curves of bundles that are algorithms of the comparison, on tasks that have a score.

    The runs of a task are compared by the same measurement: by periodic evaluations where all runs have
    them, else by the returns of the training's own episodes.
    """
    curves: dict[str, list[tuple[Path, str, TaskSpec, int]]] = {}
    for folder in sorted(agents.glob("*/")):
        algorithm = _algorithm(folder.name)
        for path in sorted(folder.glob("*/seed*.curve.csv")) if algorithm is not None else ():
            spec, seed = tasks().get(path.parent.name), re.match(r"seed(\d+)\.", path.name)
            if algorithm is not None and spec is not None and spec.anchors is not None and seed is not None:
                curves.setdefault(spec.task, []).append((path, algorithm, spec, int(seed[1])))
    found: list[Trace | None] = []
    for ones in curves.values():
        evaluated = [_read(*one, evaluated=True) for one in ones]
        trained = [_read(*one, evaluated=False) for one in ones]
        chosen = trained if None in evaluated and any(trained) else evaluated
        found += [one or other for one, other in zip(chosen, evaluated, strict=True)]
    runs = [run for run in found if run is not None]
    return sorted(runs, key=lambda run: (run.algorithm, run.task, run.seed))


def blocks(
    steps: Float[np.ndarray, "K"], score: Float[np.ndarray, "K"], most: int = _BLOCKS
) -> tuple[Float[np.ndarray, "k"], Float[np.ndarray, "k"]]:
    """Means over runs of neighbours, so that at most so many points are left."""
    parts = np.array_split(np.arange(len(steps)), min(most, len(steps)))
    return np.array([steps[part].mean() for part in parts]), np.array([score[part].mean() for part in parts])


def _algorithm(bundle: str) -> str | None:
    """The algorithm, with its label, that a bundle's name stands for."""
    for algorithm, name in BUNDLES.items():
        if bundle == name:
            return algorithm
        if bundle.startswith(f"{name}_"):
            return f"{algorithm}-{bundle[len(name) + 1 :]}"
    return None


def _read(path: Path, algorithm: str, spec: TaskSpec, seed: int, *, evaluated: bool) -> Trace | None:
    """The run of a curve on today's anchors, if what is asked for was measured.

    Args:
        path: of the curve.
        algorithm: whose.
        spec: the task.
        seed: of the training.
        evaluated: the periodic evaluations' returns; else those of the training's own episodes.
    """
    record = read_json(path.with_name(f"seed{seed}.json"))
    column = "eval_return" if evaluated else "return"
    if not evaluated and record.get("settings", {}).get("weights"):
        return None  # training paid for other things
    with path.open(encoding="utf-8", newline="") as file:
        points = [
            (float(row["steps"]), float(row[column])) for row in csv.DictReader(file) if row.get(column)
        ]
    if len(points) < 1 + evaluated:
        return None
    steps, returns = np.array(points).T
    score = np.array([spec.score(value) for value in returns])
    final = record.get("result", {}).get("return")
    last = score[steps > (1 - _END) * steps[-1]].mean()
    warm = bool(record.get("settings", {}).get("initial_policy"))
    reached = float(last if final is None else spec.score(final))
    return Trace(algorithm, spec.task, seed, steps, score, evaluated, warm, reached)
