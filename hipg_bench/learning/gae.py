"""Generalised advantage estimation."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor


def gae(
    reward: Float[Tensor, "T *#who"],
    value: Float[Tensor, "T *#who"],
    next_value: Float[Tensor, "T *#who"],
    terminated: Bool[Tensor, "T *#who"],
    done: Bool[Tensor, "T *#who"],
    gamma: float,
    gae_lambda: float,
) -> Float[Tensor, "T *who"]:
    """Advantage of each step; the value target of eqn:value_target is this plus ``value``.

    A_t = delta_t + gamma * gae_lambda * A_{t+1} with delta_t = r_t + gamma * V_{t+1} - V_t. Termination ends
    both sums; truncation ends the sum over A but still bootstraps delta from V of the state it cut.

    ``who`` is (B, K): K values a world, with one reward for all.

    Args:
        reward: r_t.
        value: V(s_t).
        next_value: V of the state that step t led to, the final state where an episode ended.
        terminated: the rules ended the episode at t.
        done: terminated or truncated at t.
        gamma: discount.
        gae_lambda: GAE's lambda; 1 gives returns minus values.
    """
    delta = reward + gamma * torch.where(terminated, 0.0, next_value) - value
    advantage = torch.empty_like(delta)
    carried = torch.zeros_like(delta[0])
    for t in range(len(delta) - 1, -1, -1):
        carried = delta[t] + gamma * gae_lambda * torch.where(done[t], 0.0, carried)
        advantage[t] = carried
    return advantage
