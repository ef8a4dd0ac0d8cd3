"""What PPO's actor ascends and its critic descends, as pure functions."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor


def surrogate(change: Float[Tensor, "X"], psi: Float[Tensor, "X"], clip: float) -> Float[Tensor, ""]:
    """PPO's clipped surrogate, to be ascended (eqn:surrogate_objective_clipped without the bonus).

    Args:
        change: log of the ratio of new to old probability.
        psi: weight of each sample.
        clip: epsilon.
    """
    ratio = change.exp()
    return torch.minimum(ratio * psi, ratio.clamp(1 - clip, 1 + clip) * psi).mean()


def value_loss(
    value: Float[Tensor, "X"], before: Float[Tensor, "X"], aim: Float[Tensor, "X"], reach: float | None
) -> Float[Tensor, ""]:
    """Mean squared error of values, of which no sample gains by moving further than ``reach``.

    Args:
        value: as the critic says now.
        before: as it said before the update.
        aim: value targets, all three in the same units.
        reach: None does not clip.
    """
    error = (value - aim).square()
    if reach is not None:
        clipped = before + (value - before).clamp(-reach, reach)
        error = torch.maximum(error, (clipped - aim).square())
    return error.mean()
