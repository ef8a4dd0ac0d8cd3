"""Results for other tools: the JSON that marl-eval reads (Gorsane et al. 2022, arXiv 2209.10485).

``environment -> task -> algorithm -> run -> step_<k>, absolute_metrics -> metric -> [a value per episode]``.
We evaluate trained agents, so each run has one step, whose values are those of ``absolute_metrics``.
marl-eval normalises with the lowest and highest value present; our ``score`` needs none of that.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from hipg_bench.errors import HipgError
from hipg_bench.evaluation.comparing import read, rows_of
from hipg_bench.evaluation.episodes import Row
from hipg_bench.evaluation.splits import STANDARD

_ENVIRONMENT = "hipg_bench"
_METRICS = ("return", "score", "survival", "deaths")

Document = dict[str, dict[str, dict[str, dict[str, dict[str, dict[str, Any]]]]]]


def marl_eval(folders: Sequence[Path]) -> Document:
    """Gather evaluations, an agent and a split each.

    Args:
        folders: what `runner.evaluate` wrote.

    Raises:
        HipgError: no evaluation, or one of another version; or the same agent twice for a task and split.
    """
    document: Document = {}
    for folder in folders:
        results = read(folder)
        split = results["split"]
        tasks = document.setdefault(_ENVIRONMENT if split == STANDARD else f"{_ENVIRONMENT}_{split}", {})
        for task in (one["task"] for one in results["tasks"]):
            algorithms = tasks.setdefault(task, {})
            if results["agent"] in algorithms:
                raise HipgError(f"{folder}: {results['agent']} on {task}, {split}, is there already")
            algorithms[results["agent"]] = _runs(rows_of(folder, task))
    return document


def _runs(rows: Sequence[Row]) -> dict[str, dict[str, dict[str, Any]]]:
    """Every training seed's episodes."""
    runs: dict[str, dict[str, dict[str, Any]]] = {}
    for seed in sorted({row["train_seed"] for row in rows}):
        own = [row for row in rows if row["train_seed"] == seed]
        # what a DNF left unplayed has a return, but nobody survived in it
        metrics = {
            name: [0.0 if row[name] is None else row[name] for row in own]
            for name in _METRICS
            if name != "score" or own[0][name] is not None
        }
        runs[f"seed_{seed}"] = {"step_0": {"step_count": 0, **metrics}, "absolute_metrics": metrics}
    return runs
