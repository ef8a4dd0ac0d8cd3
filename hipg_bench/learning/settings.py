"""What a training run is told, and the values that are recommended."""

from __future__ import annotations

from collections.abc import Callable, Mapping
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
        target_kl: the actor's rate is halved above twice this divergence per epoch, raised below half;
            None leaves the rate alone.
        max_grad_norm: gradients are cut to this norm.
        std: exploration's first standard deviation, in units of full action.
        actor_hidden, critic_hidden: widths of the hidden layers.
        weights: reward weights that differ from the task's, in training only; logged returns have them.
        mask_dead: dead agents' samples take no part in the actor's update; else only the arm
            ``min_health`` leaves them without weight, as in the authors' code.
        zero_dead_actions: a dead agent's action is stored as zeros beside the log-probability of what
            it had drawn, a quirk of the authors' code; matters only where the dead are not masked.
        psi_over: Psi is normalised over the rollout's live samples, over the whole ``batch``, zeros of
            the dead included, or anew over every ``minibatch``.
        value_clip: how far a value may move in an update before its gradient is cut, in units of
            reward, as in the authors' code; None does not clip.
        normalize_inputs, normalize_returns: running normalisation of what networks see, of value targets.
        bootstrap_truncation: an episode cut by the horizon goes on in its value target; else the
            horizon counts as an end, as in the authors' code.
        spontaneous_deaths: agents per episode, in the mean, that die without a cause, in training only,
            so that the critic meets the states its counterfactual is about.
    """

    task: str
    arm: Literal["min_health", "central", "local"] = "min_health"
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
    target_kl: float | None = pydantic.Field(default=0.015, gt=0, le=1)
    max_grad_norm: float = pydantic.Field(default=1.0, gt=0)
    std: float = pydantic.Field(default=0.6, gt=0, le=5)
    actor_hidden: tuple[int, ...] = (128, 128)
    critic_hidden: tuple[int, ...] = (256, 256)
    weights: dict[str, float] = pydantic.Field(default_factory=dict[str, float])
    mask_dead: bool = True
    zero_dead_actions: bool = False
    psi_over: Literal["live", "batch", "minibatch"] = "live"
    value_clip: float | None = pydantic.Field(default=None, gt=0)
    normalize_inputs: bool = True
    normalize_returns: bool = True
    bootstrap_truncation: bool = True
    spontaneous_deaths: float = pydantic.Field(default=0.0, ge=0, le=10)

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


_PAPER: dict[str, Any] = {
    "steps": 2_500_000, "epochs": 8, "minibatches": 8, "gamma": 0.95, "lam": 1.0, "entropy": 0.01,
    "critic_rate": 5e-3, "target_kl": None, "max_grad_norm": 0.5, "std": 1.0,
    "actor_hidden": (64, 64), "critic_hidden": (64,) * 8,
    "mask_dead": False, "zero_dead_actions": True, "psi_over": "minibatch", "value_clip": 0.2,
    "normalize_inputs": False, "normalize_returns": False, "bootstrap_truncation": False,
}  # fmt: skip
_PAPER_ARMS: Mapping[str, dict[str, Any]] = {
    "local": {"critic_hidden": (64, 64), "critic_rate": 1e-3},
    "central": {},
    "min_health": {"psi_over": "batch"},
}
_PAPER_WALKERS: dict[str, Any] = {
    "steps": 5_000_000, "num_envs": 128, "rollout": 128, "epochs": 32, "minibatches": 4, "gamma": 0.99,
    "entropy": 0.0, "clip": 0.3, "actor_rate": 3e-4, "critic_rate": 3e-4, "value_clip": 10.0,
    "max_grad_norm": 1e6,
}  # fmt: skip


def paper(task: str, **changes: Any) -> Settings:
    """The paper's settings, with the quirks of the authors' code, with some changed.

    Source: facts sheet, section 5 (particles) and section 6c (walkers, where gamma, lambda, clip and
    value clip are not stated and RLlib's defaults of the time are taken). The critic is told the share
    of the horizon that has passed where the authors feed the number of steps left.

    Raises:
        UnknownNameError: no such task.
        SpecError: a setting that is not allowed.
    """
    walkers = _PAPER_WALKERS if task_spec(task).family == "multiwalker" else {}
    arm = changes.get("arm", "min_health")
    values = {"task": task, **_PAPER, **walkers, **_PAPER_ARMS.get(arm, {}), **changes}
    return parse(Settings, values, f"training {task}")


PRESETS: Mapping[str, Callable[..., Settings]] = {"recommended": recommended, "paper": paper}
"""Ready-made settings by name."""
