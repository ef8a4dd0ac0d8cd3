"""The paper's claims, each as a comparison of two samples of runs, and the rule by which it is judged.

A claim says that values x are above values y: final scores of two algorithms, gains over a part of the
training. It **holds** if the 95 % interval of P(improvement) lies above 1/2 and the permutation test is below
0.05; it **does not hold** if the interval lies below 1/2 and the test is below 0.05. There is **no
difference** if the 90 % interval lies within 1/2 +- 0.1, the equivalence test of two one-sided tests at 0.05,
and each task has five runs of both sides, since the interval of fewer says nothing; else it is **undecided**.
Tasks where one side has no run are left out, and so are runs that began with another run's policy. There is
no correction for the number of claims: about one in twenty would pass by chance.

Pooling over tasks hides an algorithm that is better on one and worse on another, so each task has a verdict
of its own, by the same rule, with Holm's correction (1979) for the number of tasks in the claim.

How far an algorithm's runs lie apart is not compared: for five runs a side the usual tests find a twofold
spread in a fifth of all cases, and the median's own run, whose distance is 0 for odd numbers, must be left
out (Hines and Hines 2000).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Literal

import numpy as np
from jaxtyping import Float

from hipg_bench.comparison.improvement import Improvement, Stratum, improvement
from hipg_bench.comparison.traces import Trace
from hipg_bench.evaluation.statistics import METHOD_RUNS

Verdict = Literal["holds", "does not hold", "no difference", "undecided", "too few runs"]
Runs = Sequence[Trace]
Values = Float[np.ndarray, "_"]

_LEVEL, _ALIKE = 0.05, 0.1
"""Of the tests; how far from 1/2 a P(improvement) may lie that makes no difference."""
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
class Single:
    """What became of a claim on one task.

    Attributes:
        found: with the permutation test's p-value as Holm corrects it.
        verdict: by the rule above.
    """

    found: Improvement
    verdict: Verdict


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
        by_stratum: the same for each task by itself.
    """

    claim: str
    suite: str
    strata: tuple[str, ...]
    missing: tuple[str, ...]
    runs: tuple[int, int]
    found: Improvement | None
    verdict: Verdict
    by_stratum: Mapping[str, Single]


def judge_all(runs: Runs) -> list[Judged]:
    """All claims on both suites."""
    fresh = [run for run in runs if not run.warm]
    return [one for suite in SUITES for one in _judge_suite(suite, fresh)]


def _judge_suite(suite: str, runs: Runs) -> list[Judged]:
    hazard, harmless = SUITES[suite], _HARMLESS[suite]

    def algorithms(
        better: str, worse: str, of: Callable[[Runs], Values], tasks: Sequence[str]
    ) -> dict[str, Stratum]:
        return {task: (of(_of(runs, better, task)), of(_of(runs, worse, task))) for task in tasks}

    compared: list[tuple[str, dict[str, Stratum]]] = [
        ("min-health is above central", algorithms("min_health", "central", finals, hazard)),
        ("central is above local", algorithms("central", "local", finals, hazard)),
        ("local is above MADDPG", algorithms("local", "maddpg", finals, hazard)),
        ("min-health's lead over central grows with the team", _growth(runs, _GROWING[suite])),
        (
            "local learns first: above central in the first fifth",
            algorithms("local", "central", early, hazard),
        ),
        (
            "local plateaus: central gains more after half-time",
            algorithms("central", "local", late_gains, hazard),
        ),
        ("QMIX fails: local is above it", algorithms("local", "qmix", finals, hazard)),
        (
            "without hazard: central is above min-health",
            algorithms("central", "min_health", finals, harmless),
        ),
    ]
    return [_judged(claim, suite, strata) for claim, strata in compared]


def finals(runs: Runs) -> Values:
    """What each run reached."""
    return np.array([run.final for run in runs])


def early(runs: Runs) -> Values:
    """Mean score in the first fifth of each run."""
    return _defined([run.between(0, _EARLY) for run in runs])


def late_gains(runs: Runs) -> Values:
    """How much each run rose from its middle fifth to its last."""
    return _defined([run.between(_END, 1) - run.between(*_HALF) for run in runs])


def verdict(found: Improvement) -> Verdict:
    """By the rule that this file begins with."""
    low, high = found.ci95
    if found.chance < _LEVEL and not low <= 0.5 <= high:
        return "holds" if low > 0.5 else "does not hold"
    low, high = found.ci90
    alike = found.fewest >= METHOD_RUNS and low > 0.5 - _ALIKE and high < 0.5 + _ALIKE
    return "no difference" if alike else "undecided"


def _growth(runs: Runs, pairs: Sequence[tuple[str, str]]) -> dict[str, Stratum]:
    """Leads of min-health over central in the larger team and in the smaller, runs paired by seed."""
    return {f"{small} to {large}": (_leads(runs, large), _leads(runs, small)) for small, large in pairs}


def _leads(runs: Runs, task: str) -> Values:
    ours, theirs = (
        {run.seed: run.final for run in _of(runs, algorithm, task)} for algorithm in ("min_health", "central")
    )
    return np.array([ours[seed] - theirs[seed] for seed in sorted(ours.keys() & theirs.keys())])


def _judged(claim: str, suite: str, strata: dict[str, Stratum]) -> Judged:
    enough = {name: pair for name, pair in strata.items() if min(map(len, pair)) > 0}
    missing = tuple(name for name in strata if name not in enough)
    counts = (sum(len(x) for x, _ in enough.values()), sum(len(y) for _, y in enough.values()))
    if not enough:
        return Judged(claim, suite, (), missing, counts, None, "too few runs", {})
    found = improvement(list(enough.values()))
    singles = _singles(enough)
    return Judged(claim, suite, tuple(enough), missing, counts, found, verdict(found), singles)


def _singles(strata: Mapping[str, Stratum]) -> dict[str, Single]:
    """Each task by itself; the k-th smallest of n p-values times n - k + 1, never falling (Holm)."""
    found = {name: improvement([pair]) for name, pair in strata.items()}
    least, singles = 0.0, dict[str, Single]()
    for rank, name in enumerate(sorted(found, key=lambda name: found[name].chance)):
        least = max(least, min(1.0, found[name].chance * (len(found) - rank)))
        corrected = dataclasses.replace(found[name], chance=least)
        singles[name] = Single(corrected, verdict(corrected))
    return {name: singles[name] for name in strata}


def _of(runs: Runs, algorithm: str, task: str) -> Runs:
    return [run for run in runs if (run.algorithm, run.task) == (algorithm, task)]


def _defined(values: list[float]) -> Values:
    return np.array([value for value in values if np.isfinite(value)])
