"""Finished runs become bundles: weights, record, learning curve and score of every training seed.

A run with seed k of an algorithm on a task comes to lie in ``<agents>/<bundle>/<task>/``:

    seed<k>.safetensors          the last policy, not the one that periodic evaluations found best
    seed<k>.json                 the run's record, and its score by the standard protocol
    seed<k>.curve.csv            raw rows of the learning curve, at most `MOST_ROWS`
    seed<k>.learner.safetensors  the networks an audit needs; of seed 0 only, to bound the size
    seed<k>.initial.safetensors    the policy that the run began with, if it began with one
"""

from __future__ import annotations

import csv
import dataclasses
import hashlib
import io
import json
import shutil
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np

from hipg_bench.comparison.cards import card_text, readme
from hipg_bench.errors import BundleError
from hipg_bench.evaluation.episodes import EvaluationJob, Row
from hipg_bench.evaluation.statistics import mean_ci95
from hipg_bench.learning.sweep import Run
from hipg_bench.paths import replacing, write_text
from hipg_bench.policies.network import load_network
from hipg_bench.registry import task_spec

MOST_ROWS = 300
"""Of a curve; all rows with a periodic evaluation come first."""
BUNDLES = {
    "min_health": "mappo_minhealth",
    "central": "mappo_central",
    "local": "mappo_local",
    "ma_poca": "ma_poca",
    "coma": "coma",
    "difference_rewards": "difference_rewards",
    "maddpg": "maddpg",
    "qmix": "qmix",
}
"""Algorithm to the name of its bundle."""


@dataclasses.dataclass(frozen=True)
class Collected:
    """What became of a run.

    Attributes:
        run: the run.
        bundle: its bundle's name.
        state: ``new``; ``there``, the same policy is in the bundle already; ``kept``, another one is, and
            stays; ``unfinished``; ``stale``, the task has changed since.
    """

    run: Run
    bundle: str
    state: Literal["new", "there", "kept", "unfinished", "stale"]


def bundle_name(algorithm: str) -> str:
    """The bundle of an algorithm, perhaps with a label: ``central-masked`` is in ``mappo_central_masked``.

    Raises:
        BundleError: a credit rule from outside, for which there is no bundle.
    """
    plain, _, label = algorithm.partition("-")
    if plain not in BUNDLES:
        raise BundleError(
            f"runs of own credit rules ({plain}) are not collected: there are {', '.join(BUNDLES)}"
        )
    return BUNDLES[plain] + (f"_{label}" if label else "")


def collect(
    runs: Sequence[Run], agents: Path, *, replace: bool = False, job: EvaluationJob | None = None
) -> Iterator[Collected]:
    """Make artefacts of what is finished, one run after another; the cards are written at the end.

    Args:
        runs: of a sweep.
        agents: the folder of bundles.
        replace: overwrite another policy of the same seed.
        job: which worlds the score is of, by default the standard protocol's.

    Yields:
        What became of each run.
    """
    touched: set[Path] = set()
    for run in runs:
        folder = agents / bundle_name(run.algorithm)
        state = _state(run, folder, replace)
        if state == "new":
            _add(run, folder, job or EvaluationJob())
            touched.add(folder)
        yield Collected(run, folder.name, state)
    for folder in sorted(touched):
        write_text(folder / "README.md", readme(folder))


def thinned(rows: list[dict[str, str]], most: int = MOST_ROWS) -> list[dict[str, str]]:
    """At most so many rows of a curve, unchanged: those with a score, then evenly from the others."""
    if len(rows) <= most:
        return rows
    scored = [k for k, row in enumerate(rows) if row.get("score")]
    others = [k for k, row in enumerate(rows) if not row.get("score")]
    chosen = _evenly(scored, most)
    chosen += _evenly(others, most - len(chosen))
    return [rows[k] for k in sorted(chosen)]


def _evenly(items: list[int], n: int) -> list[int]:
    """At most n of the items, the first and the last among them."""
    if len(items) <= n:
        return items
    return [items[round(place)] for place in np.linspace(0, len(items) - 1, n)] if n else []


def _state(run: Run, folder: Path, replace: bool) -> Literal["new", "there", "kept", "unfinished", "stale"]:
    record = run.record
    if record is None or not run.finished:
        return "unfinished"
    if record["task_fingerprint"] != task_spec(run.settings.task).fingerprint:
        return "stale"
    weights = _place(run, folder).with_suffix(".safetensors")
    if not weights.exists():
        return "new"
    if weights.read_bytes() == (run.out / "policy.safetensors").read_bytes():
        return "there"
    return "new" if replace else "kept"


def _place(run: Run, folder: Path) -> Path:
    """The files' common path, without an ending."""
    return folder / run.settings.task / f"seed{run.settings.seed}"


def _add(run: Run, folder: Path, job: EvaluationJob) -> None:
    """Write a run's files; the policy goes last: where it is, all the others are."""
    place, settings = _place(run, folder), run.settings
    policy, record = run.out / "policy.safetensors", run.record
    if record is None or not policy.exists():
        raise BundleError(f"{run.out} holds no finished run")
    if not (folder / "agent.toml").exists():
        write_text(folder / "agent.toml", card_text(run.algorithm, folder.name))
    rows = job.play_all(task_spec(settings.task), load_network(policy))
    write_text(
        place.with_suffix(".json"),
        json.dumps({**record, "train_seed": settings.seed, "result": result(settings.task, rows)}, indent=2)
        + "\n",
    )
    write_text(place.with_suffix(".curve.csv"), _thinned_text((run.out / "curve.csv").read_text()))
    if "initial_policy_fingerprint" in record:
        _copy(_start(run, record), place.with_suffix(".initial.safetensors"))
    learner = run.out / "learner.safetensors"
    if settings.seed == 0 and learner.exists():
        _copy(learner, place.with_suffix(".learner.safetensors"))
    _copy(policy, place.with_suffix(".safetensors"))


def _start(run: Run, record: dict[str, Any]) -> Path:
    """The policy that a run began with, without which nobody can repeat it."""
    path = Path(record["settings"]["initial_policy"])
    fingerprint = hashlib.sha256(path.read_bytes()).hexdigest() if path.exists() else ""
    if not fingerprint.startswith(record["initial_policy_fingerprint"]):
        raise BundleError(f"{run.out} began with {path}, which is gone or has changed since")
    return path


def result(task: str, rows: Sequence[Row]) -> dict[str, Any]:
    """What the episodes came to: means, and 95 % bootstrap intervals over the episodes."""
    spec = task_spec(task)
    returns, interval = mean_ci95([np.array([row["return"] for row in rows])])
    anchored = spec.anchors is not None
    metrics = {
        name: [row["metrics"][name] for row in rows if row["metrics"].get(name) is not None]
        for name in rows[0]["metrics"]
    }
    return {
        "episodes": len(rows),
        "return": returns,
        "return_ci95": list(interval),
        "score": spec.score(returns) if anchored else None,
        "score_ci95": [spec.score(end) for end in interval] if anchored else None,
        "survival": float(np.mean([row["survival"] for row in rows])),
        "metrics": {name: float(np.mean(values)) for name, values in metrics.items() if values},
    }


def _thinned_text(curve: str) -> str:
    rows = list(csv.DictReader(io.StringIO(curve)))
    text = io.StringIO()
    writer = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(thinned(rows))
    return text.getvalue()


def _copy(source: Path, target: Path) -> None:
    with replacing(target) as temporary:
        shutil.copyfile(source, temporary)
