"""COMA for continuous actions (Foerster et al. 2018): a counterfactual baseline over the own action.

A central critic Q(s, u) is asked about the joint action u and about others, in which agent i alone does
something else. Foerster et al. sum over the discrete actions of agent i (their equation 4); here the sum is a
mean over ``credit_samples`` actions that the policy draws where agent i acts.

Q learns the lambda-return (their TD(lambda), equation 2 of section 2), whose bootstrapped value is
V(s) = E_u Q(s, u), a mean over as many joint actions of the policy. Dead agents' actions are zero.
"""

from __future__ import annotations

from typing import cast

import torch
from jaxtyping import Float
from torch import Tensor

from hipg_bench.layout import TaskLayout
from hipg_bench.learning.credit import CreditInputs, credit_rule
from hipg_bench.learning.critics import RolloutCritic, Samples
from hipg_bench.learning.networks import Actor, Critic
from hipg_bench.learning.rollout import End, Rollout
from hipg_bench.learning.settings import Settings


class ActionCritic(Critic, RolloutCritic):
    """Q(s, u), of the joint state and all agents' actions.

    Attributes:
        draws: joint actions that an expected value is a mean over.
    """

    def __init__(self, settings: Settings, layout: TaskLayout) -> None:
        """Make a critic with the settings' widths."""
        super().__init__(
            layout.state.size,
            settings.critic_hidden,
            layout.health_columns,
            normalize=settings.normalize_inputs,
            normalize_returns=settings.normalize_returns,
            further=len(layout.health_columns) * layout.action.size,
        )
        self._health, self._dead = torch.as_tensor(layout.health_columns), layout.dead_value
        self.draws = settings.credit_samples

    def update_norm(self, data: Rollout) -> None:
        """Take a rollout into the running normalisation of states."""
        self.norm.update(data.state[:-1].flatten(0, -2))

    def alive(self, state: Float[Tensor, "*B S"]) -> Float[Tensor, "*B N 1"]:
        """1 for agents that live, else 0."""
        return (state[..., self._health] != self._dead).float()[..., None]

    def q(
        self, state: Float[Tensor, "*B S"], elapsed: Float[Tensor, "*B"], action: Float[Tensor, "*B N A"]
    ) -> Float[Tensor, "*B"]:
        """Q in units of reward."""
        value = self.predict(self.joint_inputs(state, elapsed, action))
        return value * self.returns.scale + self.returns.offset

    def joint_inputs(
        self, state: Float[Tensor, "*B S"], elapsed: Float[Tensor, "*B"], action: Float[Tensor, "*B N A"]
    ) -> Float[Tensor, "*B I"]:
        """What the network is fed; actions of the dead are zero."""
        joint = (action * self.alive(state)).flatten(-2)
        return torch.cat([self.inputs(state, elapsed), joint], dim=-1)

    def values(self, view: Rollout | End, actor: Actor) -> Float[Tensor, "*T B 1"]:
        """V(s) = E_u Q(s, u) over actions of the policy."""
        policy = actor(view.observation)
        drawn = [self.q(view.state, view.elapsed, policy.sample()) for _ in range(self.draws)]
        return torch.stack(drawn).mean(0)[..., None]

    def samples(self, data: Rollout, target: Float[Tensor, "T B K"]) -> Samples:
        """Joint states and actions with their lambda-returns, X = T * B."""
        inputs = self.joint_inputs(data.state[:-1], data.elapsed[:-1], data.action)
        return Samples((inputs.flatten(0, 1),), target.flatten())

    def predict(self, *inputs: Tensor) -> Float[Tensor, "*X"]:
        """Q in units of the deviation of returns."""
        return self.normalized(*inputs)


@credit_rule(critic=ActionCritic, always_masks=True)
def coma(inputs: CreditInputs) -> Float[Tensor, "T B N"]:
    """Psi_i = Q(s, u) - E_{u'_i} Q(s, (u_-i, u'_i)), u'_i from the policy."""
    data, critic = inputs.data, cast(ActionCritic, inputs.critic)
    state, elapsed = data.state[:-1], data.elapsed[:-1]
    chosen = critic.q(state, elapsed, data.action)
    policy = inputs.actor(data.observation[:-1])
    baseline = torch.zeros_like(data.health)
    for _ in range(critic.draws):
        other = policy.sample()
        for i in range(baseline.shape[-1]):
            changed = data.action.clone()
            changed[..., i, :] = other[..., i, :]
            baseline[..., i] += critic.q(state, elapsed, changed) / critic.draws
    return chosen[..., None] - baseline
