"""Two evaluations side by side, world by world."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from hipg_bench.errors import HipgError
from hipg_bench.evaluation.statistics import Interval, paired_difference

_SAME = ("split", "seed", "commitment", "episodes_per_policy")
"""What two evaluations must share, so that they met the same worlds."""


def read(folder: Path) -> dict[str, Any]:
    """What ``results.json`` of a finished evaluation holds.

    Raises:
        HipgError: there is none.
    """
    path = folder / "results.json"
    if not path.is_file():
        raise HipgError(f"{folder} holds no results.json: it is not a finished evaluation")
    return json.loads(path.read_text(encoding="utf-8"))


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
            found[name] = paired_difference(_scores(ours, name), _scores(theirs, name))
    return found


def _scores(folder: Path, task: str) -> np.ndarray:
    """Score of every training run (first axis) in every world."""
    lines = (folder / "episodes" / f"{task}.jsonl").read_text(encoding="utf-8").splitlines()
    rows = [json.loads(line) for line in lines]
    runs = len({row["train_seed"] for row in rows})
    # rows are in the order of training seeds, then worlds
    return np.array([row["score"] for row in rows]).reshape(runs, -1)
