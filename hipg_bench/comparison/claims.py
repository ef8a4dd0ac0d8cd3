"""The paper's claims, each as a comparison of two samples of runs, and the rule by which it is judged.

A claim says that values x are above values y: final scores of two arms, their deviations from the median,
gains over a part of the training. It **holds** if the 95 % interval of P(improvement) lies above 1/2 and the
permutation test is below 0.05; it **does not hold** if the interval lies below 1/2 and the test is below
0.05; else it is **undecided**. Tasks where one side has no run are left out; where runs are compared by how
far they are apart, those where one side has fewer than three. There is no correction for the number of
claims: about one in twenty would pass by luck.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Literal

import numpy as np
from jaxtyping import Float

from hipg_bench.comparison.improvement import Improvement, Stratum, improvement
from hipg_bench.comparison.traces import Trace

Verdict = Literal["holds", "does not hold", "undecided", "too few runs"]
Runs = Sequence[Trace]
Values = Float[np.ndarray, "_"]

_FEWEST_APART = 3
"""Runs of which distances from the median can differ: those of two are equal."""
_LEVEL = 0.05
_EARLY, _HALF, _END = 0.2, (0.4, 0.6), 0.8
"""Shares of a run: its beginning ends, its middle, its end begins."""

PAPER = ("paper_nav-4", "paper_nav-8", "paper_comm-10", "paper_comm-16")
STANDARD = ("hazard_nav-4", "hazard_nav-8", "hazard_comm-10", "hazard_comm-16")
WALKERS = ("multiwalker-3", "multiwalker-5")
PLANAR = ("multiwalker_planar-3", "multiwalker_planar-5")
SUITES: dict[str, tuple[str, ...]] = {"paper": (*PAPER, *PLANAR), "standard": (*STANDARD, *WALKERS)}
"""Tasks with a hazard: where the paper's main claims are about."""
_GROWING: dict[str, tuple[tuple[str, str], ...]] = {
    "paper": (("paper_nav-4", "paper_nav-8"), ("paper_comm-10", "paper_comm-16")),
    "standard": (("hazard_nav-4", "hazard_nav-8"), ("hazard_comm-10", "hazard_comm-16")),
}
_HARMLESS: dict[str, tuple[str, ...]] = {"paper": ("paper_coop_nav-3",), "standard": ("coop_nav-3",)}
TASKS = tuple(task for suite in SUITES for task in (*SUITES[suite], *_HARMLESS[suite]))
"""All tasks of the comparison."""


@dataclasses.dataclass(frozen=True)
class Judged:
    """A claim and what became of it.

    Attributes:
        claim: the sentence.
        suite: ``paper`` or ``standard``: whose tasks were looked at.
        strata: tasks (or pairs of tasks) that were compared.
        missing: those that had too few runs.
        runs: values of x and of y in all strata.
        found: None where there are too few runs.
        verdict: by the rule above.
    """

    claim: str
    suite: str
    strata: tuple[str, ...]
    missing: tuple[str, ...]
    runs: tuple[int, int]
    found: Improvement | None
    verdict: Verdict


def judge_all(runs: Runs) -> list[Judged]:
    """All claims on both suites."""
    return [one for suite in SUITES for one in _judge_suite(suite, runs)]


def _judge_suite(suite: str, runs: Runs) -> list[Judged]:
    hazard, harmless = SUITES[suite], _HARMLESS[suite]

    def arms(
        better: str, worse: str, of: Callable[[Runs], Values], tasks: Sequence[str]
    ) -> dict[str, Stratum]:
        return {task: (of(_of(runs, better, task)), of(_of(runs, worse, task))) for task in tasks}

    compared: list[tuple[str, dict[str, Stratum]]] = [
        ("min-health is above central", arms("min_health", "central", finals, hazard)),
        ("central is above local", arms("central", "local", finals, hazard)),
        ("local is above MADDPG", arms("local", "maddpg", finals, hazard)),
        ("min-health's lead over central grows with the team", _growth(runs, _GROWING[suite])),
        ("min-health's runs differ less than central's", arms("central", "min_health", spreads, hazard)),
        (
            "local learns first: above central in the first fifth",
            arms("local", "central", early, hazard),
        ),
        ("local plateaus: central gains more after half-time", arms("central", "local", late_gains, hazard)),
        ("QMIX fails: local is above it", arms("local", "qmix", finals, hazard)),
        ("without hazard: central is above min-health", arms("central", "min_health", finals, harmless)),
        ("without hazard: min-health's runs differ more", arms("min_health", "central", spreads, harmless)),
    ]
    return [_judged(claim, suite, strata) for claim, strata in compared]


def finals(runs: Runs) -> Values:
    """What each run reached."""
    return np.array([run.final for run in runs])


def spreads(runs: Runs) -> Values:
    """How far each run ended from the median run (Brown and Forsythe 1974); nothing of fewer than three."""
    if len(runs) < _FEWEST_APART:
        return np.empty(0)
    reached = finals(runs)
    return np.abs(reached - np.median(reached))


def early(runs: Runs) -> Values:
    """Mean score in the first fifth of each run."""
    return _defined([run.between(0, _EARLY) for run in runs])


def late_gains(runs: Runs) -> Values:
    """How much each run rose from its middle fifth to its last."""
    return _defined([run.between(_END, 1) - run.between(*_HALF) for run in runs])


def verdict(found: Improvement) -> Verdict:
    """By the rule that this file begins with."""
    low, high = found.ci95
    if found.chance >= _LEVEL or low <= 0.5 <= high:
        return "undecided"
    return "holds" if low > 0.5 else "does not hold"


def _growth(runs: Runs, pairs: Sequence[tuple[str, str]]) -> dict[str, Stratum]:
    """Leads of min-health over central in the larger team and in the smaller, runs paired by seed."""
    return {f"{small} to {large}": (_leads(runs, large), _leads(runs, small)) for small, large in pairs}


def _leads(runs: Runs, task: str) -> Values:
    ours, theirs = (
        {run.seed: run.final for run in _of(runs, arm, task)} for arm in ("min_health", "central")
    )
    return np.array([ours[seed] - theirs[seed] for seed in sorted(ours.keys() & theirs.keys())])


def _judged(claim: str, suite: str, strata: dict[str, Stratum]) -> Judged:
    enough = {name: pair for name, pair in strata.items() if min(map(len, pair)) > 0}
    missing = tuple(name for name in strata if name not in enough)
    counts = (sum(len(x) for x, _ in enough.values()), sum(len(y) for _, y in enough.values()))
    if not enough:
        return Judged(claim, suite, (), missing, counts, None, "too few runs")
    found = improvement(list(enough.values()))
    return Judged(claim, suite, tuple(enough), missing, counts, found, verdict(found))


def _of(runs: Runs, arm: str, task: str) -> Runs:
    return [run for run in runs if (run.arm, run.task) == (arm, task)]


def _defined(values: list[float]) -> Values:
    return np.array([value for value in values if np.isfinite(value)])
