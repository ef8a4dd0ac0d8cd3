"""How sure it is that one sample lies above another, over several tasks, with few values in each.

The unit is the training run. P(improvement) is the probability that a random x is above a random y of the
same stratum (ties count half), averaged over strata: Agarwal et al. 2021. Its bootstrap interval says nothing
where the samples do not overlap: then it is [1, 1], be there two values or two hundred. A permutation test
within the strata stands beside it; it cannot come below 0.1 for 3 values against 3, 0.029 for 4 against 4.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

_REPS = 5_000

Stratum = tuple[Float[np.ndarray, "_"], Float[np.ndarray, "_"]]
"""Values x and y of one task."""


@dataclasses.dataclass(frozen=True)
class Improvement:
    """Over all strata.

    Attributes:
        p: P(improvement).
        ci95: its stratified bootstrap interval.
        chance: two-sided p-value of the permutation test: how often labels drawn at random within every
            stratum bring P as far from 1/2.
    """

    p: float
    ci95: tuple[float, float]
    chance: float


def improvement(strata: Sequence[Stratum], *, reps: int = _REPS, seed: int = 1) -> Improvement:
    """Compare x with y; every stratum needs a value of each."""
    chance = np.random.default_rng(seed)
    p = float(np.mean([_above(x[None], y[None])[0] for x, y in strata]))
    drawn = np.mean([_above(_redrawn(x, reps, chance), _redrawn(y, reps, chance)) for x, y in strata], axis=0)
    shuffled = np.mean([_shuffled(x, y, reps, chance) for x, y in strata], axis=0)
    low, high = np.percentile(drawn, [2.5, 97.5])
    # the data themselves are one of the ways in which labels may fall
    as_far = np.abs(shuffled - 0.5) >= abs(p - 0.5) - 1e-12
    return Improvement(p, (float(low), float(high)), float((1 + as_far.sum()) / (1 + reps)))


def _above(x: Float[np.ndarray, "R n"], y: Float[np.ndarray, "R m"]) -> Float[np.ndarray, "R"]:
    """Share of pairs with x above y, ties half."""
    difference = x[:, :, None] - y[:, None, :]
    return ((difference > 0) + 0.5 * (difference == 0)).mean(axis=(1, 2))


def _redrawn(x: Float[np.ndarray, "n"], reps: int, chance: np.random.Generator) -> np.ndarray:
    return x[chance.integers(len(x), size=(reps, len(x)))]


def _shuffled(
    x: Float[np.ndarray, "n"], y: Float[np.ndarray, "m"], reps: int, chance: np.random.Generator
) -> Float[np.ndarray, "R"]:
    """P where labels mean nothing."""
    drawn = chance.permuted(np.tile(np.concatenate([x, y]), (reps, 1)), axis=1)
    return _above(drawn[:, : len(x)], drawn[:, len(x) :])
