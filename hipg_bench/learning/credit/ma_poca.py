"""MA-POCA (Cohen et al. 2021, arXiv 2111.05992): posthumous credit by attention over those who live.

No absorbing state stands for the dead: the value V is of the set of living agents' observations, and the
baseline of agent j is of its own observation and the others' observations and actions, which marginalises its
own action by leaving it out. Residual self-attention (RSA) over the set, then a mean, then a head, as in
their section on the method; both learn the same lambda-return, whose bootstrapped value is V of those who
live then. An agent that died in between so gets the team's later reward for what it did.

Here V and the baselines share the attention; the embedding of (o, a) is a layer of its own, as in the paper.
The elapsed share of the horizon is appended to every observation.
"""

from __future__ import annotations

import math
from typing import cast

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from hipg_bench.layout import TaskLayout
from hipg_bench.learning.credit import CreditInputs, credit_rule
from hipg_bench.learning.critics import RolloutCritic, Samples
from hipg_bench.learning.networks import Actor, RunningNorm, Tanh, mlp
from hipg_bench.learning.rollout import End, Rollout
from hipg_bench.learning.settings import Settings


class LivingCritic(RolloutCritic):
    """V of the living agents' observations, and each agent's baseline; D is the first width of the critic."""

    def __init__(self, settings: Settings, layout: TaskLayout) -> None:
        """Make a critic whose embeddings have the first of the settings' widths, and its head the others."""
        super().__init__()
        self._health, self._dead = torch.as_tensor(layout.health_columns), layout.dead_value
        size, *hidden = settings.critic_hidden
        seen = layout.observation.size
        self.norm = RunningNorm(seen, None if settings.normalize_inputs else np.arange(seen))
        self.returns = RunningNorm(1, None if settings.normalize_returns else np.arange(1))
        self.embed = mlp((seen + 1, size), nn.ELU, math.sqrt(2))
        self.embed_acting = mlp((seen + 1 + layout.action.size, size), nn.ELU, math.sqrt(2))
        self.attention = mlp((size, 3 * size), nn.ELU, 1.0)
        self.head = mlp((size, *hidden, 1), nn.ELU, 1.0)
        self._activation = Tanh()

    def update_norm(self, data: Rollout) -> None:
        """Take the living agents' observations into the running normalisation."""
        self.norm.update(data.observation[:-1][data.health > 0])

    def values(self, view: Rollout | End, actor: Actor) -> Float[Tensor, "*T B 1"]:
        """V of those who live; 0 returns are expected where nobody does."""
        alive = view.state[..., self._health] != self._dead
        value = self.team_value(self.tokens(view.observation, view.elapsed), alive)
        return (value * self.returns.scale + self.returns.offset)[..., None]

    def samples(self, data: Rollout, target: Float[Tensor, "T B K"]) -> Samples:
        """Of each step, X = T * B: the team's value and living agents' baselines, P = 1 + N predictions."""
        alive = data.health.flatten(0, 1) > 0
        seen = self.tokens(data.observation[:-1], data.elapsed[:-1]).flatten(0, 1)
        aim = target.flatten()[:, None].expand(-1, 1 + alive.shape[1])
        counted = torch.cat([torch.ones_like(alive[:, :1]), alive], dim=1)
        return Samples((seen, data.action.flatten(0, 1), alive), aim, counted)

    def predict(self, *inputs: Tensor) -> Float[Tensor, "X P"]:
        """V, and each agent's baseline, P = 1 + N, in units of the deviation of returns."""
        seen, action, alive = inputs
        return torch.cat([self.team_value(seen, alive)[:, None], self.baselines(seen, action, alive)], dim=1)

    def team_value(self, seen: Float[Tensor, "*B N I"], alive: Bool[Tensor, "*B N"]) -> Float[Tensor, "*B"]:
        """V of the living agents' observations; 0 where nobody lives."""
        token = self._activation(self.embed(seen))
        query, key, value = self.attention(token).chunk(3, dim=-1)
        somebody = alive.any(-1)
        # a row without a finite fit would be NaN
        share = _softmax(query @ key.mT, (alive | ~somebody[..., None])[..., None, :], token.shape[-1])
        weight = alive.float() / alive.sum(-1, keepdim=True).clamp(min=1)
        pooled = (weight[..., None] * (token + share @ value)).sum(-2)
        return self.head(pooled)[..., 0] * somebody

    def baselines(
        self, seen: Float[Tensor, "X N I"], action: Float[Tensor, "X N A"], alive: Bool[Tensor, "X N"]
    ) -> Float[Tensor, "X N"]:
        """For each agent j: of its observation, and of the others' observations and actions.

        The sets of two agents differ by two embeddings only. So queries, keys and values are made once of
        every agent's embedding with and without its action, fits [j, i, k] are put together from theirs, and
        what the queries i get is averaged before values are mixed: nothing of size N * N * D is made.
        """
        own = self._activation(self.embed(seen))
        acting = self._activation(self.embed_acting(torch.cat([seen, action], dim=-1)))
        own_query, own_key, own_value = self.attention(own).chunk(3, dim=-1)
        query, key, value = self.attention(acting).chunk(3, dim=-1)
        mine = torch.eye(seen.shape[1], dtype=torch.bool)
        asks, asked = mine[:, :, None], mine[:, None, :]  # i is j, k is j
        fit = torch.where(asked, (query @ own_key.mT).mT[:, :, :, None], (query @ key.mT)[:, None])
        of_own = torch.where(mine, (own_query * own_key).sum(-1)[:, :, None], own_query @ key.mT)
        fit = torch.where(asks, of_own[:, :, None, :], fit)
        there = alive[:, None] | mine
        share = _softmax(fit, there[:, :, None, :], own.shape[-1])
        weight = there.float() / there.sum(-1, keepdim=True)
        mix = (weight[..., None] * share).sum(2)  # what k gives to j's mean
        others = weight.masked_fill(mine, 0) @ acting + mix.masked_fill(mine, 0) @ value
        self_weight, self_mix = (m.diagonal(dim1=1, dim2=2)[..., None] for m in (weight, mix))
        return self.head(others + self_weight * own + self_mix * own_value)[..., 0]

    def tokens(
        self, observation: Float[Tensor, "*B N O"], elapsed: Float[Tensor, "*B"]
    ) -> Float[Tensor, "*B N I"]:
        """Normalised observations with the elapsed share of the horizon."""
        share = elapsed[..., None, None].expand(*observation.shape[:-1], 1)
        return torch.cat([self.norm(observation), share], dim=-1)


def _softmax(
    fit: Float[Tensor, "*X i k"], there: Bool[Tensor, "*X #i k"], size: int
) -> Float[Tensor, "*X i k"]:
    """Shares of the scaled fits of those who are there."""
    return (fit / math.sqrt(size)).masked_fill(~there, -torch.inf).softmax(-1)


@credit_rule(critic=LivingCritic, always_masks=True)
def ma_poca(inputs: CreditInputs) -> Float[Tensor, "T B N"]:
    """Psi_j = V_targ - b_j, b_j of the own observation and the others' observations and actions."""
    critic = cast(LivingCritic, inputs.critic)
    data = inputs.data
    baselines = [  # by steps, to bound memory
        critic.baselines(critic.tokens(observation, elapsed), action, health > 0)
        for observation, elapsed, action, health in zip(
            data.observation[:-1], data.elapsed[:-1], data.action, data.health, strict=True
        )
    ]
    return inputs.target - (torch.stack(baselines) * critic.returns.scale + critic.returns.offset)
