"""What a training run is told, and the values that are recommended."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

import pydantic

from hipg_bench.registry import task_spec
from hipg_bench.spec import Params, parse


class Settings(Params):
    """Everything that defines a training run: same settings, same result, on one machine.

    Attributes:
        task: task name.
        arm: how credit is assigned, a function of `hipg_bench.learning.credit`.
        seed: fixes initial weights, worlds, exploration and minibatches; evaluation has seeds from 1000 on,
            so that nobody is scored on worlds they were trained in.
        steps: environment steps in all (each moves N agents).
        num_envs: B worlds side by side.
        rollout: T control steps of each between updates.
        epochs, minibatches: passes over a rollout, and parts each is cut into.
        gamma, lam: discount and GAE's lambda.
        clip: PPO's epsilon.
        entropy: weight of the entropy bonus.
        actor_rate: the actor's first learning rate; it then follows ``target_kl``.
        critic_rate: the critic's learning rate.
        target_kl: the actor's rate is halved above twice this divergence per epoch, raised below half.
        max_grad_norm: gradients are cut to this norm.
        std: exploration's first standard deviation, in units of full action.
        actor_hidden, critic_hidden: widths of the hidden layers.
        weights: reward weights that differ from the task's, in training only; logged returns have them.
    """

    task: str
    arm: Literal["min_health", "central"] = "min_health"
    seed: int = pydantic.Field(default=0, ge=0, le=999)
    steps: int = pydantic.Field(default=6_000_000, ge=1)
    num_envs: int = pydantic.Field(default=256, ge=1, le=65536)
    rollout: int = pydantic.Field(default=50, ge=1, le=10_000)
    epochs: int = pydantic.Field(default=5, ge=1, le=100)
    minibatches: int = pydantic.Field(default=4, ge=1, le=1000)
    gamma: float = pydantic.Field(default=0.98, ge=0, le=1)
    lam: float = pydantic.Field(default=0.95, ge=0, le=1)
    clip: float = pydantic.Field(default=0.2, gt=0, lt=1)
    entropy: float = pydantic.Field(default=0.002, ge=0, le=1)
    actor_rate: float = pydantic.Field(default=1e-3, gt=0, le=1)
    critic_rate: float = pydantic.Field(default=1e-3, gt=0, le=1)
    target_kl: float = pydantic.Field(default=0.015, gt=0, le=1)
    max_grad_norm: float = pydantic.Field(default=1.0, gt=0)
    std: float = pydantic.Field(default=0.6, gt=0, le=5)
    actor_hidden: tuple[int, ...] = (128, 128)
    critic_hidden: tuple[int, ...] = (256, 256)
    weights: dict[str, float] = pydantic.Field(default_factory=dict[str, float])

    @property
    def iterations(self) -> int:
        """Rollouts in all, the last one whole."""
        return -(-self.steps // (self.num_envs * self.rollout))


_BY_FAMILY: Mapping[str, dict[str, Any]] = {
    # reward is so rare at first that noise would collapse exploration without a strong bonus
    "hazard_comm": {"epochs": 4, "minibatches": 8, "entropy": 0.01},
    "multiwalker": {
        "steps": 8_000_000, "num_envs": 384, "rollout": 32, "minibatches": 6, "gamma": 0.99,
        "entropy": 0.002, "std": 0.3,  # more noise than this and nobody stays on their feet to learn
        "weights": {"alive": 0.1},  # without it teams learn to dive before they learn to stand
    },
}  # fmt: skip
"""Where a family does better with other values than the defaults."""


def recommended(task: str, **changes: Any) -> Settings:
    """The recommended settings for a task, with some changed.

    Raises:
        UnknownNameError: no such task.
        SpecError: a setting that is not allowed.
    """
    values = {"task": task, **_BY_FAMILY.get(task_spec(task).family, {}), **changes}
    return parse(Settings, values, f"training {task}")
