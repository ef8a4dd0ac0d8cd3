"""Learning curves of the comparison: the paper's panels, the appendix's, and our own suite's.

Each family is drawn twice: mean with the range from the worst to the best run, as in the paper, and
interquartile mean with a 95 % bootstrap band over runs. What was not trained is not drawn; its panel says so.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from scipy import stats

from hipg_bench.comparison.traces import Trace, blocks
from hipg_bench.paths import replacing

Band = Literal["range", "iqm"]

FAMILIES: dict[str, tuple[str, ...]] = {
    "paper": (
        "paper_nav-4", "paper_comm-10", "multiwalker_planar-3",
        "paper_nav-8", "paper_comm-16", "multiwalker_planar-5",
    ),
    "appendix": ("paper_coop_nav-3", "coop_nav-3"),
    "standard": (
        "hazard_nav-4", "hazard_comm-10", "multiwalker-3", "hazard_nav-8", "hazard_comm-16", "multiwalker-5",
    ),
    "masking": ("paper_comm-10", "hazard_comm-10"),
}  # fmt: skip
"""Panels of each figure: the paper's campaigns, its appendix, our tasks with a hazard, what masking does.

Where there are two rows, the larger team is below the smaller.
"""
_ALGORITHMS: dict[str, tuple[str, str, str]] = {
    "min_health": ("min-health", "#0072B2", "o"),
    "central": ("central", "#E69F00", "X"),
    "local": ("local", "#009E73", "^"),
    "ma_poca": ("MA-POCA", "#56B4E9", "v"),
    "coma": ("COMA", "#999933", "<"),
    "difference_rewards": ("difference rewards", "#332288", ">"),
    "maddpg": ("MADDPG", "#D55E00", "P"),
    "qmix": ("QMIX", "#AA4499", "D"),
}
"""Name, colour (told apart by the colour-blind, after Okabe and Ito) and marker (the paper's)."""
_VARIANTS = (
    ("#000000", "s"),
    ("#56B4E9", "v"),
    ("#CC79A7", "<"),
    ("#999933", ">"),
    ("#882255", "p"),
    ("#44AA99", "d"),
)
"""Colour and marker of variants, in the order of their names."""
_REPS = 1000
_INK, _PALE = "#222222", "#8a8a8a"


def draw_all(runs: Sequence[Trace], out: Path) -> list[Path]:
    """Write all figures; those of a family that has no runs at all are left out.

    Returns:
        The files.
    """
    files: list[Path] = []
    for family, tasks in FAMILIES.items():
        algorithms = _algorithms_of(family, tasks, runs)
        if not algorithms:
            continue
        shown = [run for run in runs if run.task in tasks and run.algorithm in algorithms]
        for band in ("range", "iqm"):
            path = out / f"{family}{'' if band == 'range' else '_iqm'}.png"
            figure = draw(shown, tasks, algorithms, band)
            with replacing(path) as temporary:
                # no date or version inside: the same runs give the same bytes
                figure.savefig(temporary, dpi=150, format="png", metadata={"Software": None})
            files.append(path)
    return files


def figure_names() -> list[str]:
    """Names of the files that `draw_all` may write."""
    return [f"{family}{band}.png" for family in FAMILIES for band in ("", "_iqm")]


def draw(runs: Sequence[Trace], tasks: Sequence[str], algorithms: Sequence[str], band: Band) -> Figure:
    """Draw one panel per task."""
    columns = 2 if len(tasks) in (2, 4) else 3
    rows = math.ceil(len(tasks) / columns)
    figure = Figure(figsize=(4.3 * columns, 3.3 * rows + 0.9), layout="constrained")
    panels = figure.subplots(rows, columns, squeeze=False).flatten()
    for k, (axes, task) in enumerate(zip(panels, tasks, strict=True)):
        _panel(axes, task, [run for run in runs if run.task == task], algorithms, band)
        if k % columns == 0:
            axes.set_ylabel("score")
        if k >= len(tasks) - columns and axes.lines:
            axes.set_xlabel("environment steps, millions")
    figure.legend(
        handles=[
            Line2D([], [], color=colour, marker=marker, linewidth=2, markersize=7, label=name)
            for name, colour, marker in styles_of(algorithms).values()
        ],
        loc="outside lower center",
        ncols=3 if any("-" in algorithm for algorithm in algorithms) else len(algorithms),
        frameon=False,
        fontsize=12,
    )
    what = "mean, worst and best run" if band == "range" else "interquartile mean, 95 % bootstrap band"
    of = _source(runs)
    figure.suptitle(
        f"{what}; 0 as random actions, 1 as the reference; {of}", fontsize=11, color=_INK, x=0.01, ha="left"
    )
    return figure


def band_of(
    runs: Sequence[Trace], band: Band
) -> tuple[Float[np.ndarray, "K"], Float[np.ndarray, "K"], Float[np.ndarray, "K"], Float[np.ndarray, "K"]]:
    """Steps, middle, lower and upper end of an algorithm's runs, where all of them have been."""
    curves = [blocks(run.steps, run.score) for run in runs]
    first, last = max(steps[0] for steps, _ in curves), min(steps[-1] for steps, _ in curves)
    grid = np.linspace(first, last, min(len(steps) for steps, _ in curves))
    values = np.array([np.interp(grid, steps, score) for steps, score in curves])
    if band == "range":
        return grid, values.mean(axis=0), values.min(axis=0), values.max(axis=0)
    chance = np.random.default_rng(1)
    drawn = values[chance.integers(len(values), size=(_REPS, len(values)))]
    low, high = np.percentile(stats.trim_mean(drawn, 0.25, axis=1), [2.5, 97.5], axis=0)
    return grid, stats.trim_mean(values, 0.25, axis=0), low, high


def _panel(axes: Axes, task: str, runs: Sequence[Trace], algorithms: Sequence[str], band: Band) -> None:
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(labelsize=10, colors=_INK)
    axes.set_title(task, fontsize=13, loc="left", color=_INK)
    if not runs:
        axes.text(0.5, 0.5, "no runs", transform=axes.transAxes, ha="center", fontsize=13, color=_PALE)
        axes.set_xticks([])
        axes.set_yticks([])
        return
    for level in (0.0, 1.0):
        axes.axhline(level, color=_PALE, linewidth=0.8, linestyle=(0, (1, 3)), zorder=0)
    styles, counts = styles_of(algorithms), list[int]()
    for algorithm in algorithms:
        own = [run for run in runs if run.algorithm == algorithm]
        if not own:
            continue
        steps, middle, low, high = band_of(own, band)
        _, colour, marker = styles[algorithm]
        every = max(1, len(steps) // 8)
        axes.fill_between(steps / 1e6, low, high, color=colour, alpha=0.14, linewidth=0)
        axes.plot(
            steps / 1e6, middle, color=colour, linewidth=2,
            marker=marker, markevery=every, markersize=6, markeredgecolor="white", markeredgewidth=0.6,
        )  # fmt: skip
        counts.append(len(own))
    few, many = min(counts), max(counts)
    told = f"{few} to {many} runs" if few < many else f"{many} run{'s' if many > 1 else ''} each"
    axes.set_title(told, fontsize=9, loc="right", color=_PALE)
    axes.set_xlim(left=0)


def styles_of(algorithms: Sequence[str]) -> dict[str, tuple[str, str, str]]:
    """Name, colour and marker of each algorithm and variant."""
    styles, spare = dict[str, tuple[str, str, str]](), itertools.cycle(_VARIANTS)
    for algorithm in algorithms:
        plain, _, label = algorithm.partition("-")
        name, colour, marker = _ALGORITHMS[plain]
        variant = f"{name}, {label.replace('_', ', ')}"
        styles[algorithm] = (variant, *next(spare)) if label else (name, colour, marker)
    return styles


def _algorithms_of(family: str, tasks: Sequence[str], runs: Sequence[Trace]) -> list[str]:
    """The algorithms to draw, plain ones first; variants belong to the figure about masking only."""
    there = {run.algorithm for run in runs if run.task in tasks}
    variants = sorted(algorithm for algorithm in there if "-" in algorithm)
    if family == "masking":
        return (
            [algorithm for algorithm in ("min_health", "central") if algorithm in there] + variants
            if variants
            else []
        )
    return [algorithm for algorithm in _ALGORITHMS if algorithm in there]


def _source(runs: Sequence[Trace]) -> str:
    """What the scores are of."""
    evaluated = {run.evaluated for run in runs}
    if evaluated == {True}:
        return "periodic evaluations without exploration"
    return (
        "training episodes, with exploration"
        if evaluated == {False}
        else "periodic evaluations, or training episodes"
    )
