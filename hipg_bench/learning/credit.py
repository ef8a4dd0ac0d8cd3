"""Who gets the credit: one pure function per algorithm of the paper's comparison.

Each maps what a central critic knows to the weight Psi_i that multiplies agent i's log-probability
gradient (eqn:policy_gradients_multi_agent).
"""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor


def advantage(
    target: Float[Tensor, "X K"], value: Float[Tensor, "X K"], health: Float[Tensor, "X N"]
) -> Float[Tensor, "X N"]:
    """Psi_i = h_i (V_targ - V): ``central`` with V(s) shared by all, ``local`` with V(o_i) of each.

    Args:
        target: V_targ of eqn:value_target, K = 1 for all agents or K = N.
        value: the critic's value of the same.
        health: h_i, in [0, 1].
    """
    return health * (target - value)


def min_health(
    target: Float[Tensor, "X 1"], without: Float[Tensor, "X N"], health: Float[Tensor, "X N"]
) -> Float[Tensor, "X N"]:
    """Psi_i = h_i (V_targ - V(s with only h_i := 0)), eqn:min_health_baseline_ppo.

    Args:
        target: V_targ of eqn:value_target.
        without: the critic's value of the same state with agent i dead.
        health: h_i, in [0, 1].
    """
    return health * (target - without)


def with_each_dead(
    state: Float[Tensor, "X S"], health_columns: np.ndarray, dead_value: float
) -> Float[Tensor, "X N S"]:
    """N copies of each joint state, in the i-th of which only agent i's health is set to 0."""
    n = len(health_columns)
    copies = state[:, None, :].repeat(1, n, 1)
    copies[:, torch.arange(n), torch.as_tensor(health_columns)] = dead_value
    return copies


def normalized(psi: Float[Tensor, "X N"], counted: Bool[Tensor, "X N"]) -> Float[Tensor, "X N"]:
    """Zero mean and unit deviation over the counted samples; 0 for the others."""
    chosen = psi[counted]
    return torch.where(counted, (psi - chosen.mean()) / (chosen.std() + 1e-8), 0.0)
