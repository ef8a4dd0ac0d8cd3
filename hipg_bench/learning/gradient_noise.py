"""How much a baseline can matter: the noise of the actor's gradient under each, on the same episodes.

A baseline leaves the gradient's mean alone (lemma 1), however right or wrong it is; all that it can do is
take noise away. So one that leaves a share f of another's noise is worth 1/f times as many episodes, and
no more. That bounds what the algorithms ``central`` and ``min_health``, which differ by the baseline, can
differ by at this point of the training.
"""

from __future__ import annotations

import dataclasses

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from hipg_bench.learning.credit.central import central
from hipg_bench.learning.credit.min_health import min_health
from hipg_bench.learning.mappo import Trainer
from hipg_bench.learning.networks import Actor, Critic
from hipg_bench.learning.rollout import Rollout
from hipg_bench.learning.settings import Settings
from hipg_bench.registry import task_spec

_RESAMPLES = 2000


@dataclasses.dataclass(frozen=True)
class GradientNoise:
    """What the baselines leave of the gradient's noise.

    Attributes:
        noise: trace of the covariance over episodes of an episode's gradient, as a multiple of what the
            baseline V(s) leaves: of "none" (the mean target alone), "central" (1 by definition),
            "min_health" (V(s with only h_i := 0)).
        interval: 95 % of each by bootstrap over episodes.
        scale: episodes whose mean gradient has as much noise as signal under V(s), the gradient noise
            scale of McCandlish et al. (2018); None where no signal is seen.
        episodes: how many were played.
    """

    noise: dict[str, float]
    interval: dict[str, tuple[float, float]]
    scale: float | None
    episodes: int


def gradient_noise(
    actor: Actor, critic: Critic, settings: Settings, *, worlds: int = 256, seed: int = 500
) -> GradientNoise:
    """Compare baselines on whole episodes of a policy as it explores.

    Args:
        actor: the policy.
        critic: of the joint state.
        settings: of the run, as `hipg_bench.learning.audit.load` gives them.
        worlds: episodes, two or more.
        seed: of the episodes and of all random numbers.
    """
    whole = {"rollout": task_spec(settings.task).horizon, "num_envs": worlds, "seed": seed}
    trainer = Trainer(settings.model_copy(update=whole))
    trainer.actor.load_state_dict(actor.state_dict())
    trainer.critic.load_state_dict(critic.state_dict())
    data = trainer.roll_out()
    gradients = _gradients(trainer.actor, data, _weights(trainer, data))

    distance = {
        name: (each - each.mean(0)).square().sum(1).double().numpy() for name, each in gradients.items()
    }
    noise = float(distance["central"].sum()) / (worlds - 1)
    signal = float(gradients["central"].mean(0).square().sum()) - noise / worlds
    drawn = np.random.default_rng(seed).integers(worlds, size=(_RESAMPLES, worlds))
    base = distance["central"][drawn].sum(1)
    return GradientNoise(
        noise={name: float(each.sum() / distance["central"].sum()) for name, each in distance.items()},
        interval={
            name: tuple(np.quantile(each[drawn].sum(1) / base, [0.025, 0.975]).tolist())
            for name, each in distance.items()
        },
        scale=noise / signal if signal > 0 else None,
        episodes=worlds,
    )


@torch.no_grad()
def _weights(trainer: Trainer, data: Rollout) -> dict[str, Float[Tensor, "T B N"]]:
    """Psi under each baseline, in units of reward, with zero mean over the live samples."""
    inputs = trainer.credit_inputs(data)
    psi = {
        "none": inputs.target,
        "central": central.psi(inputs),
        "min_health": min_health.psi(inputs),
    }
    live = data.health > 0
    return {
        name: torch.where(live, each - each[live].mean(), 0.0)
        for name, each in ((name, data.health * each) for name, each in psi.items())
    }


def _gradients(
    actor: Actor, data: Rollout, psi: dict[str, Float[Tensor, "T B N"]]
) -> dict[str, Float[Tensor, "B P"]]:
    """Every episode's gradient of sum_t,i Psi_i log pi(a_i | o_i), by baseline."""
    parameters = list(actor.parameters())
    rows: dict[str, list[Tensor]] = {name: [] for name in psi}
    for b in range(data.health.shape[1]):
        log_prob = actor(data.observation[:-1, b]).log_prob(data.action[:, b]).sum(-1)
        for name, weight in psi.items():
            parts = torch.autograd.grad((weight[:, b] * log_prob).sum(), parameters, retain_graph=True)
            rows[name].append(torch.cat([part.flatten() for part in parts]))
    return {name: torch.stack(each) for name, each in rows.items()}
