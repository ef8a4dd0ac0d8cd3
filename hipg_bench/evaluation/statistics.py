"""Interval estimates of means, by bootstrap. Reports are computed from raw rows by these alone.

The unit of replication is the training run: where there are several, runs are drawn with
replacement, then episodes within each drawn run. With one run the interval speaks of the episodes'
luck only, not of the training's.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from scipy import stats

_REPS = 10_000
_CHUNK = 2_000_000
"""Numbers drawn at once, so that memory stays small."""

Interval = tuple[float, float]
Runs = Sequence[Float[np.ndarray, "_"]]
"""One task: the values of every episode, an array per training run."""


def mean_ci95(runs: Runs, *, reps: int = _REPS, seed: int = 1) -> tuple[float, Interval]:
    """Mean over runs of the mean over episodes, with a 95 % percentile bootstrap interval."""
    chance = np.random.default_rng(seed)
    return float(np.mean([run.mean() for run in runs])), _ends(_run_means(runs, reps, chance).mean(axis=1))


def iqm_ci95(tasks: Sequence[Runs], *, reps: int = _REPS, seed: int = 1) -> tuple[float, Interval]:
    """Interquartile mean over all (run, task) means, bootstrapped within each task (stratified).

    The middle half of the means counts: one task can neither carry an agent nor sink it. After
    Agarwal et al. 2021, "Deep reinforcement learning at the edge of the statistical precipice".
    """
    chance = np.random.default_rng(seed)
    means = [run.mean() for runs in tasks for run in runs]
    drawn = np.concatenate([_run_means(runs, reps, chance) for runs in tasks], axis=1)
    return float(stats.trim_mean(means, 0.25)), _ends(stats.trim_mean(drawn, 0.25, axis=1))


def _run_means(runs: Runs, reps: int, chance: np.random.Generator) -> Float[np.ndarray, "reps R"]:
    """Means of as many redrawn runs as there are, ``reps`` times."""
    source = chance.integers(len(runs), size=(reps, len(runs)))
    means = np.empty(source.shape)
    for k, run in enumerate(runs):
        chosen = source == k
        means[chosen] = _episode_means(run, int(chosen.sum()), chance)
    return means


def _episode_means(run: Float[np.ndarray, "_"], times: int, chance: np.random.Generator) -> np.ndarray:
    """Means of the run's episodes drawn with replacement."""
    step = max(1, _CHUNK // run.size)
    sizes = [min(step, times - start) for start in range(0, times, step)]
    return np.concatenate(
        [run[chance.integers(run.size, size=(size, run.size))].mean(axis=1) for size in sizes]
    )


def _ends(means: Float[np.ndarray, "reps"]) -> Interval:
    low, high = np.percentile(means, [2.5, 97.5])
    return float(low), float(high)
