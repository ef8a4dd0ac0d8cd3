"""MADDPG (Lowe et al. 2017) on TorchRL's losses and modules, top to bottom.

Every agent has an actor of its own, which acts on its own observation, and a critic of its own, which
sees the joint state and all actions. Critic i learns Q_i of the team's reward by TD(0) on replayed steps;
actor i ascends Q_i in its own action, all other actions being those that were played. Truncation
bootstraps, termination does not.

Dead agents' steps stay in the replay, with their observation of zeros. Recommended: their actions are
zeros for every critic, also those a target would take, so that what they are told changes no value and
their actors have no gradient. In the authors' code only stored actions are zeros.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.data import Bounded
from torchrl.modules import AdditiveGaussianModule, MultiAgentMLP
from torchrl.objectives import DDPGLoss, SoftUpdate

from hipg_bench.learning.replay import ReplayTrainer
from hipg_bench.learning.settings import MaddpgSettings
from hipg_bench.policies.network import NetworkSpec


class Actors(nn.Module):
    """N deterministic policies."""

    def __init__(
        self, num_agents: int, observation_size: int, action_size: int, hidden: tuple[int, ...]
    ) -> None:
        super().__init__()
        self.body = _apart(num_agents, observation_size, action_size, hidden)

    def forward(
        self, observation: Float[Tensor, "X N O"], acting: Float[Tensor, "X N"]
    ) -> tuple[Float[Tensor, "X N A"], Float[Tensor, "X N A"]]:
        """Outputs before they are squashed, and actions in [-1, 1]; zeros for those that do not act."""
        out = self.body(observation) * acting[..., None]
        return out, torch.tanh(out)


class Critics(nn.Module):
    """N critics Q_i, each of what all see and do."""

    def __init__(self, num_agents: int, seen_size: int, action_size: int, hidden: tuple[int, ...]) -> None:
        super().__init__()
        self.num_agents = num_agents
        # the first layers of all agents on what is seen are one product: it is the same for all
        self.seen = nn.Linear(seen_size, num_agents * hidden[0], bias=False)
        self.played = _apart(num_agents, num_agents * action_size, hidden[0], ())
        self.rest = _apart(num_agents, hidden[0], 1, hidden[1:])
        self.register_buffer("own", torch.eye(num_agents, dtype=torch.bool)[..., None], persistent=False)

    own: Tensor

    def forward(
        self,
        seen: Float[Tensor, "X *N F"],
        action: Float[Tensor, "X N A"],
        played: Float[Tensor, "X N A"] | None,
    ) -> Float[Tensor, "X N 1"]:
        """Q_i of agent i's ``action`` beside what the others ``played``, or beside theirs if it is None."""
        others = action if played is None else played
        joint = torch.where(self.own, action[:, None], others[:, None]).flatten(-2)  # (X, N, N * A)
        first = self.seen(seen.flatten(1)).unflatten(-1, (self.num_agents, -1))
        return self.rest(torch.relu(first + self.played(joint)))


class Trainer(ReplayTrainer):
    """A MADDPG run."""

    def __init__(self, settings: MaddpgSettings, folder: Path) -> None:
        """Make worlds and networks; the replay is kept in ``folder``."""
        super().__init__(settings, folder)
        env, self.options = self.env, settings
        self.spec = NetworkSpec(activation="relu", head="tanh", reach=settings.action_scale)
        actors = Actors(env.num_agents, env.observation_size, env.action_size, settings.hidden)
        self.body = actors.body
        self.actor = TensorDictModule(actors, ["observation", "acting"], ["unsquashed", "action"])
        state = settings.critic_sees == "state"
        seen_size = env.state_size if state else env.num_agents * env.observation_size
        critics = Critics(env.num_agents, seen_size, env.action_size, settings.critic_hidden)
        sees = "state" if state else "observation"
        critic = TensorDictModule(critics, [sees, "action", "played"], ["state_action_value"])
        self.loss = DDPGLoss(self.actor, critic, delay_actor=True, delay_value=True)
        self.loss.make_value_estimator(gamma=settings.gamma)
        self.targets = SoftUpdate(self.loss, tau=settings.tau)
        self.optimizer = torch.optim.Adam(self.loss.parameters(), settings.rate)
        self.exploration: Any = AdditiveGaussianModule(
            Bounded(-1.0, 1.0, torch.Size([env.action_size])),
            settings.noise,
            settings.noise * settings.final_noise,
            max(1, settings.noise_steps // settings.num_envs),
        )

    def choose(
        self, observation: Float[Tensor, "B N O"], acting: Float[Tensor, "B N"]
    ) -> Float[np.ndarray, "B N A"]:
        """Each actor's action with Gaussian noise, cut to [-1, 1]."""
        seen = TensorDict({"observation": observation, "acting": acting}, observation.shape[:1])
        chosen = self.exploration(self.actor(seen))["action"]
        self.exploration.step()
        return chosen.numpy()

    def pushes(self, choice: Float[np.ndarray, "B N A"]) -> Float[np.ndarray, "B N A"]:
        """Actions in units of ``action_scale``."""
        return choice * self.options.action_scale

    def improve(self, batch: TensorDict) -> dict[str, float]:
        """Improve all actors and critics on a sample. Returns what to log."""
        settings, num_agents = self.options, self.env.num_agents
        batch["played"] = batch["action"]
        after: Any = batch["next"]
        for name in ("reward", "done", "terminated"):  # the team's are every agent's
            after[name] = after[name][:, None].expand(-1, num_agents, 1)
        losses = self.loss(batch)
        out = self.actor(batch.select("observation", "acting"))["unsquashed"]
        mean = losses["loss_value"] + losses["loss_actor"] + settings.pretanh_l2 * out.square().mean()
        self.optimizer.zero_grad()
        (num_agents * mean).backward()  # a sum of N agents' losses, which share no weight
        clip_gradients(list(self.loss.parameters()), num_agents, settings.max_grad_norm)
        self.optimizer.step()
        self.targets.step()
        return {
            "value_loss": float(losses["loss_value"].detach()),
            "value": -float(losses["loss_actor"].detach()),
            "noise": float(self.exploration.sigma),
        }

    def learned(self) -> dict[str, Any]:
        """Networks with their targets, optimiser, exploration."""
        return {"loss": self.loss, "optimizer": self.optimizer, "exploration": self.exploration}


def clip_gradients(parameters: list[nn.Parameter], num_agents: int, max_norm: float) -> None:
    """Cut each agent's gradient of each tensor to a norm; first axes run over agents, or begin with them."""
    for parameter in parameters:
        if parameter.grad is not None:
            apart = parameter.grad.unflatten(0, (num_agents, -1))
            norm = apart.flatten(1).norm(dim=1).clamp(min=1e-12)
            apart *= (max_norm / norm).clamp(max=1.0).view(-1, *(1,) * (apart.ndim - 1))


def _apart(num_agents: int, inputs: int, outputs: int, hidden: tuple[int, ...]) -> MultiAgentMLP:
    """N networks that share nothing."""
    return MultiAgentMLP(
        inputs,
        outputs,
        num_agents,
        centralized=False,
        share_params=False,
        depth=len(hidden),
        num_cells=list(hidden) or None,
        activation_class=nn.ReLU,
    )
