"""Credit rules: how the team's return becomes the weight Psi_i of each agent's log-probability gradient.

A rule is one file of this package, named as its function, which the decorator `credit_rule` makes a
`CreditRule`; what it needs beside the function (a critic of its own, rewards per agent) are the decorator's
arguments. Rules from outside are ``module:function``, decorated or not.

The trainer multiplies what the function returns by h_i where the dead are masked, and normalises it
(eqn:policy_gradients_multi_agent).
"""

from __future__ import annotations

import dataclasses
import importlib
from collections.abc import Callable
from typing import cast

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from hipg_bench.env import BatchEnv
from hipg_bench.errors import SpecError, hint
from hipg_bench.layout import TaskLayout
from hipg_bench.learning.critics import RolloutCritic, state_critic
from hipg_bench.learning.networks import Actor
from hipg_bench.learning.rollout import Rollout
from hipg_bench.learning.settings import CREDIT_RULES, Settings


@dataclasses.dataclass(frozen=True)
class CreditInputs:
    """What a rule may use.

    Attributes:
        data: the rollout.
        value: the critic's values.
        target: V_targ of eqn:value_target.
        critic: the rule's own.
        actor: the policy that acted.
        layout: of the task's vectors.
        settings: of the run.
    """

    data: Rollout
    value: Float[Tensor, "T B K"]
    target: Float[Tensor, "T B K"]
    critic: RolloutCritic
    actor: Actor
    layout: TaskLayout
    settings: Settings


Psi = Callable[[CreditInputs], Float[Tensor, "T B N"]]
"""Psi_i before masks and normalisation, (T, B, N), or (T, B, 1) where all agents have the same."""
NewCritic = Callable[[Settings, TaskLayout], RolloutCritic]
Rewards = Callable[[Rollout, BatchEnv], Float[Tensor, "T B K"]]
"""What critics value: the team's reward (K = 1), or one for each agent (K = N)."""


def team_reward(data: Rollout, env: BatchEnv) -> Float[Tensor, "T B 1"]:
    """The team's reward, the same for all agents."""
    return data.reward[..., None]


@dataclasses.dataclass(frozen=True)
class CreditRule:
    """A rule of this package, or one from outside.

    Attributes:
        psi: the rule.
        critic: makes its critic.
        rewards: what the critic values.
        always_masks: the dead have no weight even where the settings do not mask them.
        needs_rows: rollouts keep the worlds before each step.
    """

    psi: Psi
    critic: NewCritic = state_critic
    rewards: Rewards = team_reward
    always_masks: bool = False
    needs_rows: bool = False


def credit_rule(
    *,
    critic: NewCritic = state_critic,
    rewards: Rewards = team_reward,
    always_masks: bool = False,
    needs_rows: bool = False,
) -> Callable[[Psi], CreditRule]:
    """Make a function a credit rule; the arguments are those of `CreditRule`."""
    return lambda psi: CreditRule(psi, critic, rewards, always_masks, needs_rows)


def find(name: str) -> CreditRule:
    """The rule of a name, or of ``module:function``, whose module is imported and so runs.

    Raises:
        SpecError: there is no such rule, module or function.
    """
    module, colon, function = name.partition(":")
    if not colon and name not in CREDIT_RULES:
        raise SpecError(f"no credit rule {name!r}{hint(name, CREDIT_RULES)}")
    try:
        found = getattr(
            importlib.import_module(module if colon else f"{__name__}.{name}"), function or name, None
        )
    except ModuleNotFoundError as error:
        if error.name is None or not module.startswith(error.name):
            raise
        raise SpecError(f"credit rule {name!r}: there is no module {error.name!r} to import") from error
    if isinstance(found, CreditRule):
        return found
    if not callable(found):
        raise SpecError(f"credit rule {name!r}: {module} has no function {function!r}")
    return CreditRule(cast(Psi, found))


def normalized(psi: Float[Tensor, "X N"], counted: Bool[Tensor, "X N"]) -> Float[Tensor, "X N"]:
    """Zero mean and unit deviation over the counted samples; 0 for the others."""
    chosen = psi[counted]
    return torch.where(counted, (psi - chosen.mean()) / (chosen.std() + 1e-8), 0.0)
