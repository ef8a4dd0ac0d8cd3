"""Min-health crediting, eqn:min_health_baseline_ppo: the baseline is the team's value without agent i."""

from __future__ import annotations

from typing import cast

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from hipg_bench.learning.credit import CreditInputs, credit_rule
from hipg_bench.learning.critics import StateCritic


@credit_rule(always_masks=True)
def min_health(inputs: CreditInputs) -> Float[Tensor, "T B N"]:
    """Psi_i = V_targ - V(s with only h_i := 0)."""
    return inputs.target - value_without_each(inputs)


def value_without_each(inputs: CreditInputs) -> Float[Tensor, "T B N"]:
    """V(s with only h_i := 0) for every agent i."""
    data, layout, critic = inputs.data, inputs.layout, cast(StateCritic, inputs.critic)
    values: list[Tensor] = []
    for state, elapsed in zip(data.state[:-1], data.elapsed[:-1], strict=True):  # by steps, to bound memory
        copies = with_each_dead(state, layout.health_columns, layout.dead_value)
        values.append(critic(copies, elapsed[:, None].expand(copies.shape[:2])))
    return torch.stack(values)


def with_each_dead(
    state: Float[Tensor, "X S"], health_columns: np.ndarray, dead_value: float
) -> Float[Tensor, "X N S"]:
    """N copies of each joint state, in the i-th of which only agent i's health is set to 0."""
    n = len(health_columns)
    copies = state[:, None, :].repeat(1, n, 1)
    copies[:, torch.arange(n), torch.as_tensor(health_columns)] = dead_value
    return copies
