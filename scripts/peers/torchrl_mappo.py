"""MAPPO as TorchRL offers it, on one of our tasks: its collector, its `MAPPOLoss`, with our settings.

One policy shared by all agents; a critic that reads the joint state, once per world; tanh for the policy and
ELU for the critic, widths as ours; batch, epochs, minibatches and discount as ours.
"""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from tensordict.nn import NormalParamExtractor, TensorDictModule
from torch import Tensor, nn
from torchrl.collectors import Collector
from torchrl.modules import MLP, ProbabilisticActor, TanhNormal
from torchrl.objectives.multiagent import MAPPOLoss

from hipg_bench.adapters.torchrl import HipgEnv
from hipg_bench.learning.settings import Settings

OBSERVATION, ACTION, REWARD = ("agents", "observation"), ("agents", "action"), ("agents", "reward")
LOC, SCALE, VALUE = ("agents", "loc"), ("agents", "scale"), ("agents", "state_value")


class TeamCritic(nn.Module):
    """A value of the joint state, repeated for every agent, as `MAPPOLoss` asks for."""

    def __init__(self, state_size: int, hidden: tuple[int, ...], agents: int) -> None:
        super().__init__()
        self.body = MLP(state_size, 1, num_cells=hidden, activation_class=nn.ELU)
        self.agents = agents

    def forward(self, state: Tensor) -> Tensor:
        """(..., S) to (..., N, 1)."""
        return self.body(state)[..., None, :].expand(*state.shape[:-1], self.agents, 1)


class Mappo:
    """A learner; `iterate` collects a rollout and learns from it."""

    def __init__(self, settings: Settings) -> None:
        self.settings = settings
        env = HipgEnv(settings.task, settings.num_envs, reward_dead="team")
        agents, sees = env.observation_spec[OBSERVATION].shape[-2:]
        does = env.full_action_spec[ACTION].shape[-1]
        self.samples = settings.num_envs * settings.rollout * agents
        body = MLP(sees, 2 * does, num_cells=settings.actor_hidden, activation_class=nn.Tanh)
        actor = ProbabilisticActor(
            TensorDictModule(nn.Sequential(body, NormalParamExtractor()), [OBSERVATION], [LOC, SCALE]),
            in_keys=[LOC, SCALE],
            out_keys=[ACTION],
            distribution_class=TanhNormal,
            return_log_prob=True,
        )
        critic = TensorDictModule(
            TeamCritic(env.observation_spec["state"].shape[-1], settings.critic_hidden, agents),
            ["state"],
            [VALUE],
        )
        self.loss = MAPPOLoss(actor, critic, clip_epsilon=settings.clip, entropy_coeff=settings.entropy_coef)
        self.loss.set_keys(value=VALUE, action=ACTION, reward=REWARD)
        self.loss.make_value_estimator(gamma=settings.gamma, lmbda=settings.gae_lambda)
        self.optimizer = torch.optim.Adam(self.loss.parameters(), settings.actor_rate)
        frames = settings.num_envs * settings.rollout
        self.rollouts = iter(Collector(env, actor, frames_per_batch=frames, total_frames=-1))

    def iterate(self) -> int:
        """Collect, estimate advantages, update; returns how many samples were learned from, N per step."""
        batch = next(self.rollouts)
        with torch.no_grad():
            self.loss.value_estimator(
                batch,
                params=self.loss.critic_network_params,
                target_params=self.loss.target_critic_network_params,
            )
        flat = batch.reshape(-1)
        for _ in range(self.settings.epochs):
            for part in torch.randperm(len(flat)).chunk(self.settings.minibatches):
                self._descend(flat[part])
        return self.samples

    def _descend(self, part: TensorDictBase) -> None:
        losses = self.loss(part)
        total = losses["loss_objective"] + losses["loss_critic"] + losses["loss_entropy"]
        self.optimizer.zero_grad()
        total.backward()
        nn.utils.clip_grad_norm_(self.loss.parameters(), self.settings.max_grad_norm)
        self.optimizer.step()
