"""QMIX (Rashid et al. 2018) on TorchRL's losses and modules, top to bottom.

QMIX is about few discrete actions, our agents have up to six continuous ones. Each coordinate takes one of
``bins`` values; but all combinations of six would be 8^6 outputs. So every (agent, coordinate) pair is
one of QMIX's agents: all agents share one network, from the own observation to ``bins`` values for each of A
coordinates, and the mixer makes of the N * A chosen values one that rises in each, given the joint state.

There is no recurrence, and the target takes its own best choice (no double Q). Truncation bootstraps,
termination does not. Dead agents' steps stay in the replay; recommended: all values of theirs are zero,
so that what they are told changes nothing.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Shaped
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor, nn
from torchrl.data import Categorical
from torchrl.modules import EGreedyModule, MultiAgentMLP, QMixer, QValueModule
from torchrl.objectives import SoftUpdate
from torchrl.objectives.multiagent import QMixerLoss

from hipg_bench.learning.replay import ReplayTrainer
from hipg_bench.learning.settings import QmixSettings
from hipg_bench.policies.network import NetworkSpec


class Values(nn.Module):
    """Values of every pair's choices; P = N * A pairs."""

    def __init__(
        self, num_agents: int, observation_size: int, action_size: int, bins: int, hidden: tuple[int, ...]
    ) -> None:
        super().__init__()
        self.action_size, self.bins = action_size, bins
        self.body = MultiAgentMLP(
            observation_size,
            action_size * bins,
            num_agents,
            centralized=False,
            share_params=True,
            depth=len(hidden),
            num_cells=list(hidden),
            activation_class=nn.ReLU,
        )

    def forward(
        self, observation: Float[Tensor, "X N O"], acting: Float[Tensor, "X N"]
    ) -> Float[Tensor, "X P bins"]:
        """Zeros for those that do not act."""
        values = self.body(observation) * acting[..., None]
        return values.unflatten(-1, (self.action_size, self.bins)).flatten(1, 2)


class Trainer(ReplayTrainer):
    """A QMIX run."""

    choice_type = np.uint8

    def __init__(self, settings: QmixSettings, folder: Path) -> None:
        """Make worlds and networks; the replay is kept in ``folder``."""
        super().__init__(settings, folder)
        env, self.options = self.env, settings
        self.spec = NetworkSpec(activation="relu", head="bins", bins=settings.bins)
        values = Values(env.num_agents, env.observation_size, env.action_size, settings.bins, settings.hidden)
        self.body = values.body
        values_of = TensorDictModule(values, ["observation", "acting"], [("agents", "action_value")])
        best_of = QValueModule(
            action_space="categorical",
            action_value_key=("agents", "action_value"),
            out_keys=[("agents", name) for name in ("action", "action_value", "chosen_action_value")],
        )
        self.pairs = TensorDictSequential([values_of, best_of])
        mixer = TensorDictModule(
            QMixer((env.state_size,), settings.mixer_width, env.num_agents * env.action_size, device="cpu"),
            [("agents", "chosen_action_value"), "state"],
            ["chosen_action_value"],
        )
        self.loss = QMixerLoss(self.pairs, mixer, action_space="categorical", delay_value=True)
        self.loss.make_value_estimator(gamma=settings.gamma)
        self.targets = SoftUpdate(self.loss, tau=settings.tau)
        self.optimizer = torch.optim.RMSprop(self.loss.parameters(), settings.rate, alpha=0.99, eps=1e-5)
        self.exploration: Any = EGreedyModule(
            Categorical(settings.bins),
            1.0,
            settings.epsilon,
            max(1, settings.epsilon_steps // settings.num_envs),
        )

    def choose(
        self, observation: Float[Tensor, "B N O"], acting: Float[Tensor, "B N"]
    ) -> Shaped[np.ndarray, "B N A"]:
        """The best choice of every pair, or with probability epsilon any."""
        worlds = observation.shape[:1]
        best = self.pairs(TensorDict({"observation": observation, "acting": acting}, worlds))[
            "agents", "action"
        ]
        chosen = self.exploration(TensorDict({"action": best}, best.shape))["action"]
        self.exploration.step()
        return chosen.view(*worlds, self.env.num_agents, -1).numpy().astype(np.uint8)

    def pushes(self, choice: Shaped[np.ndarray, "B N A"]) -> Float[np.ndarray, "B N A"]:
        """Evenly spaced actions from -1 to 1."""
        return 2.0 * choice / (self.options.bins - 1) - 1.0

    def improve(self, batch: TensorDict) -> dict[str, float]:
        """Improve values and mixer on a sample. Returns what to log."""
        choice: Any = batch["action"]
        batch["agents", "action"] = choice.flatten(1).long()
        loss = self.loss(batch)["loss"]
        self.optimizer.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(self.loss.parameters(), self.options.max_grad_norm)
        self.optimizer.step()
        self.targets.step()
        return {"value_loss": float(loss.detach()), "epsilon": float(self.exploration.eps)}

    def learned(self) -> dict[str, Any]:
        """Networks with their targets, optimiser, exploration."""
        return {"loss": self.loss, "optimizer": self.optimizer, "exploration": self.exploration}
