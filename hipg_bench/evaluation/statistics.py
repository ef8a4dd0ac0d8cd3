"""Estimates with intervals, by bootstrap. Reports are computed from raw rows by these alone.

The unit of replication is the training run. A method's interval draws its runs with replacement, within
each task (stratified). With fewer than `METHOD_RUNS` runs that says nothing: then episodes are drawn too,
and the interval speaks of the episodes' randomness, not of the training's. After Agarwal et al. 2021, "Deep
reinforcement learning at the edge of the statistical precipice"; tested against their library, rliable.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float

METHOD_RUNS = 5
"""Fewest training seeds of a method; with fewer an entry is a checkpoint."""
MOST_RUNS = 10
"""Training seeds per task that an entry of the board may have: each tells a little of the hidden worlds."""
CLIP = (-0.5, 1.5)
"""Scores are cut to this in aggregates, so that no single task can carry or sink an agent."""
_EPISODE_REPS, _REPS = 10_000, 50_000
_CHUNK = 2_000_000
"""Numbers drawn at once, so that memory stays small."""

Interval = tuple[float, float]
Runs = Sequence[Float[np.ndarray, "_"]]
"""One task: the values of every episode, an array per training run."""
Scores = Sequence[Float[np.ndarray, "_"]]
"""A suite: an array per task, with the score of every training run."""
Drawn = Sequence[Float[np.ndarray, "... _"]]
"""The same, drawn many times over: runs are the last axis."""


def mean_ci95(runs: Runs, *, reps: int = _EPISODE_REPS, seed: int = 1) -> tuple[float, Interval]:
    """Mean over runs of the mean over episodes; runs are redrawn, then episodes within each."""
    rng = np.random.default_rng(seed)
    return float(np.mean([run.mean() for run in runs])), _ends(_run_means(runs, reps, rng).mean(axis=1))


def iqm_ci95(
    tasks: Sequence[Runs], *, clip: Interval = CLIP, reps: int = _EPISODE_REPS, seed: int = 1
) -> tuple[float, Interval]:
    """`iqm` of (run, task) means where there are few runs: episodes are redrawn within each run."""
    rng = np.random.default_rng(seed)
    means = [np.clip([run.mean() for run in runs], *clip) for runs in tasks]
    drawn = [np.clip(_run_means(runs, reps, rng), *clip) for runs in tasks]
    return float(iqm(means)), _ends(iqm(drawn))


def iqm(scores: Drawn) -> Float[np.ndarray, "..."]:
    """Interquartile mean over all runs and tasks, the mean of the middle half.

    Every task has the same weight, however many runs it has. With as many runs for every task it is
    rliable's: a quarter of the scores, rounded down to whole ones, is cut at each end.
    """
    most = max(task.shape[-1] for task in scores)
    pooled = np.concatenate(scores, axis=-1)
    weight = np.concatenate([np.full(task.shape[-1], 1 / task.shape[-1]) for task in scores]) / len(scores)
    cut = (len(scores) * most // 4) / (len(scores) * most)
    order = np.argsort(pooled, axis=-1, kind="stable")
    above = np.cumsum(weight[order], axis=-1)
    below = above - weight[order]
    kept = np.maximum(np.minimum(above, 1 - cut) - np.maximum(below, cut), 0.0)
    middle = np.take_along_axis(pooled, order, axis=-1) * kept
    return np.asarray(middle.sum(axis=-1) / kept.sum(axis=-1))


def mean(scores: Drawn) -> Float[np.ndarray, "..."]:
    """Mean over tasks of the mean over runs."""
    return np.asarray(np.mean([task.mean(axis=-1) for task in scores], axis=0))


def median(scores: Drawn) -> Float[np.ndarray, "..."]:
    """Median over tasks of the mean over runs."""
    return np.asarray(np.median([task.mean(axis=-1) for task in scores], axis=0))


def optimality_gap(scores: Drawn) -> Float[np.ndarray, "..."]:
    """How much the scores fall short of 1, the reference, on average; what lies above 1 does not help."""
    return np.asarray(1.0 - mean([np.minimum(task, 1.0) for task in scores]))


def profile(scores: Drawn, thresholds: Float[np.ndarray, "K"]) -> Float[np.ndarray, "... K"]:
    """Performance profile: share of runs above each threshold, mean over tasks."""
    return np.stack(
        [mean([(task > threshold).astype(np.float64) for task in scores]) for threshold in thresholds],
        axis=-1,
    )


def ci95(
    statistic: Callable[[Drawn], np.ndarray], scores: Scores, *, reps: int = _REPS, seed: int = 1
) -> tuple[np.ndarray, np.ndarray]:
    """Stratified bootstrap over runs: 95 % percentile interval of a statistic.

    Args:
        statistic: of scores whose last axis are the runs, such as `iqm`.
        scores: an array of runs per task.
        reps: draws.
        seed: of the draws.

    Returns:
        Lower and upper end, shaped as one value of the statistic.
    """
    rng = np.random.default_rng(seed)
    values = [
        statistic([_redrawn(task, size, rng) for task in scores])
        for size in _chunks(reps, sum(map(len, scores)))
    ]
    low, high = np.percentile(np.concatenate(values), [2.5, 97.5], axis=0)
    return np.asarray(low), np.asarray(high)


def improvement(ours: Drawn, theirs: Drawn) -> Float[np.ndarray, "..."]:
    """Chance that a run of ours beats one of theirs on a task, ties half, averaged over tasks.

    It is the Mann-Whitney U statistic over the number of pairs.
    """
    gaps = [a[..., :, None] - b[..., None, :] for a, b in zip(ours, theirs, strict=True)]
    beats = [((gap > 0) + 0.5 * (gap == 0)).mean(axis=(-2, -1)) for gap in gaps]
    return np.asarray(np.mean(beats, axis=0))


def improvement_ci95(ours: Scores, theirs: Scores, *, reps: int = _REPS, seed: int = 1) -> Interval:
    """Interval of `improvement`: both sides' runs are redrawn, within each task."""
    return improvement_intervals(ours, theirs, (0.95,), reps=reps, seed=seed)[0]


def improvement_intervals(
    ours: Scores, theirs: Scores, levels: Sequence[float], *, reps: int = _REPS, seed: int = 1
) -> list[Interval]:
    """The same at several levels, such as 0.95 and 0.9."""
    rng = np.random.default_rng(seed)
    pairs = sum(len(a) * len(b) for a, b in zip(ours, theirs, strict=True))
    values = [
        improvement(
            [_redrawn(task, size, rng) for task in ours], [_redrawn(task, size, rng) for task in theirs]
        )
        for size in _chunks(reps, pairs)
    ]
    drawn = np.concatenate(values)
    return [_ends(drawn, level) for level in levels]


def paired_difference(
    ours: Float[np.ndarray, "R W"],
    theirs: Float[np.ndarray, "Q V"],
    *,
    reps: int = _EPISODE_REPS,
    seed: int = 1,
) -> tuple[float, Interval]:
    """How much more we reach than they do in the same worlds: mean, and 95 % interval.

    Randomness that both meet cancels: worlds are redrawn together, runs on each side on their own.

    Args:
        ours: return or score of each run in each world.
        theirs: the same of the others, V = W.
        reps: draws.
        seed: of the draws.

    Raises:
        ValueError: not the same number of worlds.
    """
    if ours.shape[1] != theirs.shape[1]:
        raise ValueError(f"the same worlds are allowed, got {ours.shape[1]} and {theirs.shape[1]}")
    rng = np.random.default_rng(seed)
    worlds = ours.shape[1]
    values: list[np.ndarray] = []
    for size in _chunks(reps, worlds):
        drawn = rng.integers(worlds, size=(size, worlds))
        # how often each world was drawn: a mean over drawn worlds is a product with it
        weight = np.stack([np.bincount(row, minlength=worlds) for row in drawn]) / worlds
        sides = [weight @ side.T for side in (ours, theirs)]
        picked = [
            np.take_along_axis(side, rng.integers(side.shape[1], size=side.shape), axis=1).mean(axis=1)
            for side in sides
        ]
        values.append(picked[0] - picked[1])
    return float(ours.mean() - theirs.mean()), _ends(np.concatenate(values))


def _redrawn(task: Float[np.ndarray, "R"], size: int, rng: np.random.Generator) -> np.ndarray:
    return task[rng.integers(len(task), size=(size, len(task)))]


def _chunks(reps: int, numbers: int) -> list[int]:
    """``reps`` in parts, each of which draws few enough numbers."""
    step = max(1, _CHUNK // numbers)
    return [min(step, reps - start) for start in range(0, reps, step)]


def _run_means(runs: Runs, reps: int, rng: np.random.Generator) -> Float[np.ndarray, "reps R"]:
    """Means of as many redrawn runs as there are, ``reps`` times."""
    source = rng.integers(len(runs), size=(reps, len(runs)))
    means = np.empty(source.shape)
    for k, run in enumerate(runs):
        chosen = source == k
        means[chosen] = _episode_means(run, int(chosen.sum()), rng)
    return means


def _episode_means(run: Float[np.ndarray, "_"], times: int, rng: np.random.Generator) -> np.ndarray:
    """Means of the run's episodes drawn with replacement."""
    return np.concatenate(
        [run[rng.integers(run.size, size=(size, run.size))].mean(axis=1) for size in _chunks(times, run.size)]
    )


def _ends(means: Float[np.ndarray, "reps"], level: float = 0.95) -> Interval:
    low, high = np.percentile(means, [50 * (1 - level), 50 * (1 + level)])
    return float(low), float(high)
