"""Critics of rollouts: what a credit rule's critic must do, and the two that most rules take."""

from __future__ import annotations

import abc
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from torch import Tensor, nn

from hipg_bench.layout import TaskLayout
from hipg_bench.learning.networks import Actor, Critic, RunningNorm
from hipg_bench.learning.rollout import End, Rollout
from hipg_bench.learning.settings import Settings


class Samples(NamedTuple):
    """What a critic is trained on.

    Attributes:
        inputs: of its network, X rows each.
        aim: value targets in units of reward, (X,), or (X, P) for P predictions.
        counted: which of them count, None for all.
    """

    inputs: tuple[Tensor, ...]
    aim: Float[Tensor, "X *P"]
    counted: Bool[Tensor, "X *P"] | None = None


class RolloutCritic(nn.Module, abc.ABC):
    """A credit rule's critic.

    Attributes:
        returns: running mean and deviation of the value targets.
    """

    returns: RunningNorm

    @abc.abstractmethod
    def update_norm(self, data: Rollout) -> None:
        """Take a rollout into the running normalisation of inputs."""

    @abc.abstractmethod
    def values(self, view: Rollout | End, actor: Actor) -> Float[Tensor, "*T B K"]:
        """Values in units of reward, which value targets bootstrap from; K = 1 for the team, or K = N."""

    @abc.abstractmethod
    def samples(self, data: Rollout, target: Float[Tensor, "T B K"]) -> Samples:
        """What it is trained on: X samples of a rollout with their value targets."""

    @abc.abstractmethod
    def predict(self, *inputs: Tensor) -> Float[Tensor, "X *P"]:
        """What is trained towards `Samples.aim`, in units of the deviation of ``returns``."""


class StateCritic(Critic, RolloutCritic):
    """V(s): the team's value of the joint state."""

    def views(self, view: Rollout | End) -> tuple[Float[Tensor, "*T B K F"], Float[Tensor, "*T B K"]]:
        """What it observes, and the elapsed share of the horizon."""
        seen = view.state[..., None, :]
        return seen, view.elapsed[..., None].expand(seen.shape[:-1])

    def update_norm(self, data: Rollout) -> None:
        """Take a rollout into the running normalisation of inputs."""
        self.norm.update(self.views(data)[0][:-1].flatten(0, -2))

    def values(self, view: Rollout | End, actor: Actor) -> Float[Tensor, "*T B K"]:
        """Values in units of reward; the policy does not matter to them."""
        return self(*self.views(view))

    def samples(self, data: Rollout, target: Float[Tensor, "T B K"]) -> Samples:
        """What it is trained on, X = T * B * K."""
        seen, elapsed = self.views(data)
        return Samples((self.inputs(seen[:-1], elapsed[:-1]).flatten(0, -2),), target.flatten())

    def predict(self, *inputs: Tensor) -> Float[Tensor, "X"]:
        """What is trained towards the value targets, in units of the deviation of ``returns``."""
        return self.normalized(*inputs)


class ObservationCritic(StateCritic):
    """V(o_i): one network for all agents, of each one's own observation."""

    def __init__(self, *sizes: Any, mask_dead: bool, **options: Any) -> None:
        """Make a critic whose values of dead agents are not trained if ``mask_dead``."""
        super().__init__(*sizes, **options)
        self.mask_dead = mask_dead

    def views(self, view: Rollout | End) -> tuple[Float[Tensor, "*T B K F"], Float[Tensor, "*T B K"]]:
        """What it observes, and the elapsed share of the horizon; K = N."""
        seen = view.observation
        return seen, view.elapsed[..., None].expand(seen.shape[:-1])

    def samples(self, data: Rollout, target: Float[Tensor, "T B K"]) -> Samples:
        """What it is trained on, X = T * B * N."""
        samples = super().samples(data, target)
        return samples._replace(counted=data.health.flatten() > 0) if self.mask_dead else samples


def state_critic(settings: Settings, layout: TaskLayout) -> StateCritic:
    """A critic of the joint state; columns of health are not normalised."""
    return StateCritic(
        layout.state.size,
        settings.critic_hidden,
        layout.health_columns,
        normalize=settings.normalize_inputs,
        normalize_returns=settings.normalize_returns,
    )


def observation_critic(settings: Settings, layout: TaskLayout) -> ObservationCritic:
    """A critic of each agent's own observation."""
    return ObservationCritic(
        layout.observation.size,
        settings.critic_hidden,
        np.empty(0, np.int64),
        mask_dead=settings.mask_dead_values,
        normalize=settings.normalize_inputs,
        normalize_returns=settings.normalize_returns,
    )
