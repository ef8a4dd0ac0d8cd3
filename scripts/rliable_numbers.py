"""What rliable 1.2.0 makes of fixed matrices: the numbers of ``tests/reference/rliable.json``.

It needs an environment of its own, as it does not start beside today's pandas and arch:

    python3 -m venv .venv-rliable
    .venv-rliable/bin/pip install rliable==1.2.0 'pandas<3' 'arch<8' 'numpy<2'
    .venv-rliable/bin/python scripts/rliable_numbers.py tests/reference/rliable.json
"""

import json
import sys
from pathlib import Path

import numpy as np
from rliable import library, metrics

REPS = 4_000
THRESHOLDS = np.linspace(-0.25, 1.25, 7)


def numbers(ours: np.ndarray, theirs: np.ndarray) -> dict:
    """Points and intervals for two methods' scores, (runs, tasks)."""
    points = {
        "iqm": metrics.aggregate_iqm,
        "mean": metrics.aggregate_mean,
        "median": metrics.aggregate_median,
        "optimality_gap": metrics.aggregate_optimality_gap,
    }
    values, intervals = library.get_interval_estimates(
        {"ours": ours}, lambda x: np.array([point(x) for point in points.values()]), reps=REPS
    )
    better, ends = library.get_interval_estimates(
        {"pair": (ours, theirs)}, metrics.probability_of_improvement, reps=REPS
    )
    profile, band = library.create_performance_profile({"ours": ours}, THRESHOLDS, reps=REPS)
    return {
        "ours": ours.tolist(),
        "theirs": theirs.tolist(),
        "points": dict(zip(points, values["ours"].tolist(), strict=True)),
        "intervals": dict(zip(points, intervals["ours"].T.tolist(), strict=True)),
        "improvement": float(better["pair"]),
        "improvement_ci95": ends["pair"].ravel().tolist(),
        "profile": profile["ours"].tolist(),
        "profile_ci95": band["ours"].tolist(),
    }


def main() -> None:
    """Write the file."""
    chance = np.random.default_rng(2026)
    np.random.seed(1)  # noqa: NPY002  rliable draws from the old generator
    smooth = chance.normal(0.6, 0.25, (10, 6)) + np.linspace(-0.3, 0.3, 6)
    weaker = chance.normal(0.5, 0.3, (8, 6)) + np.linspace(-0.3, 0.3, 6)
    # few runs, ties, and scores outside 0 and 1
    coarse = np.round(chance.normal(0.7, 0.6, (5, 7)), 1)
    other = np.round(chance.normal(0.6, 0.6, (5, 7)), 1)
    golden = {
        "rliable": "1.2.0",
        "reps": REPS,
        "thresholds": THRESHOLDS.tolist(),
        "cases": [numbers(smooth, weaker), numbers(coarse, other)],
    }
    Path(sys.argv[1]).write_text(json.dumps(golden, indent=1) + "\n")


if __name__ == "__main__":
    main()
