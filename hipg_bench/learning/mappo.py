"""MAPPO with min-health crediting (algorithm 1 of the paper), top to bottom.

One policy, shared by all agents, acts on each agent's own observation; one central critic sees the
joint state, health included. What sets the arms apart is `_credit`: how the team's advantage becomes
each agent's weight Psi_i.

Differences from the authors' code, in every arm: dead samples are masked and Psi is normalised over
live samples only; returns are normalised instead of clipping the value's change; the critic knows how
much of the horizon has passed; truncation bootstraps, termination does not.
"""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from hipg_bench.env import BatchEnv, Step
from hipg_bench.errors import ResumeError
from hipg_bench.learning import credit
from hipg_bench.learning.gae import gae
from hipg_bench.learning.networks import Actor, Critic
from hipg_bench.learning.settings import Settings
from hipg_bench.paths import replacing
from hipg_bench.registry import make

_RATES = (1e-5, 2e-3)
"""Bounds of the actor's learning rate."""


@dataclasses.dataclass
class Rollout:
    """T steps of B worlds, and where they led."""

    observation: Float[Tensor, "T B N O"]
    state: Float[Tensor, "T B S"]
    elapsed: Float[Tensor, "T B"]  # share of the horizon
    health: Float[Tensor, "T B N"]
    action: Float[Tensor, "T B N A"]
    log_prob: Float[Tensor, "T B N"]
    reward: Float[Tensor, "T B"]
    terminated: Bool[Tensor, "T B"]
    done: Bool[Tensor, "T B"]
    next_state: Float[Tensor, "T B S"]  # what the step led to, before any autoreset
    next_elapsed: Float[Tensor, "T B"]
    episodes: list[dict[str, float]]  # metrics of those that ended


class Trainer:
    """Everything a run carries from one iteration to the next."""

    def __init__(self, settings: Settings) -> None:
        torch.manual_seed(settings.seed)
        self.settings = settings
        self.env: BatchEnv = make(
            settings.task,
            settings.num_envs,
            settings.seed,
            threads=torch.get_num_threads(),
            weights=settings.weights,
        )
        layout = self.env.layout
        self.actor = Actor(
            self.env.observation_size, self.env.action_size, settings.actor_hidden, settings.std
        )
        self.critic = Critic(self.env.state_size, settings.critic_hidden, layout.health_columns)
        self.actor_optimizer = torch.optim.Adam(self.actor.parameters(), settings.actor_rate, eps=1e-5)
        self.critic_optimizer = torch.optim.Adam(self.critic.parameters(), settings.critic_rate, eps=1e-5)
        self.iteration = 0
        self.step: Step = self.env.reset()

    def iterate(self) -> dict[str, float]:
        """One round of algorithm 1: roll out, value targets, credit, update. Returns what to log."""
        data = self.roll_out()
        self._learn_scales(data)
        target, psi = self._credit(data)
        log = self._update_actor(data, psi) | self._update_critic(data, target)
        self.iteration += 1
        for name in data.episodes[0] if data.episodes else ():
            # mean over the episodes in which the metric is defined
            values = np.array([episode[name] for episode in data.episodes])
            if np.isfinite(values).any():
                log[name] = float(np.nanmean(values))
        return log | {"episodes": float(len(data.episodes))}

    @torch.no_grad()
    def roll_out(self) -> Rollout:
        """Run the policy for T steps in every world."""
        settings, env = self.settings, self.env
        T, B, N = settings.rollout, env.num_envs, env.num_agents  # noqa: N806
        data = Rollout(
            observation=torch.empty(T, B, N, env.observation_size),
            state=torch.empty(T, B, env.state_size),
            elapsed=torch.empty(T, B),
            health=torch.empty(T, B, N),
            action=torch.empty(T, B, N, env.action_size),
            log_prob=torch.empty(T, B, N),
            reward=torch.empty(T, B),
            terminated=torch.empty(T, B, dtype=torch.bool),
            done=torch.empty(T, B, dtype=torch.bool),
            next_state=torch.empty(T, B, env.state_size),
            next_elapsed=torch.empty(T, B),
            episodes=[],
        )
        for t in range(T):
            was = self.step
            data.observation[t] = torch.from_numpy(was.observation)
            data.state[t] = torch.from_numpy(was.info["state"])
            data.elapsed[t] = torch.from_numpy(was.info["elapsed"]) / env.spec.horizon
            data.health[t] = torch.from_numpy(was.info["health"])
            policy = self.actor(data.observation[t])
            data.action[t] = policy.sample()
            data.log_prob[t] = policy.log_prob(data.action[t]).sum(-1)
            now = self.step = env.step(data.action[t].numpy())
            data.reward[t] = torch.from_numpy(now.reward)
            data.terminated[t] = torch.from_numpy(now.terminated)
            data.done[t] = torch.from_numpy(now.terminated | now.truncated)
            data.next_state[t] = torch.from_numpy(now.info["final_state"])
            data.next_elapsed[t] = data.elapsed[t] + 1 / env.spec.horizon
            for b in np.flatnonzero(data.done[t].numpy()):
                data.episodes.append({name: float(values[b]) for name, values in now.info["metrics"].items()})
        return data

    def _learn_scales(self, data: Rollout) -> None:
        """Update the normalisation of what live agents see and of joint states."""
        self.actor.norm.update(data.observation[data.health > 0])
        self.critic.norm.update(data.state.flatten(0, 1))

    @torch.no_grad()
    def _credit(self, data: Rollout) -> tuple[Float[Tensor, "T B"], Float[Tensor, "T B N"]]:
        """Value targets (eqn:value_target), and each agent's normalised weight Psi (the arm)."""
        settings = self.settings
        value = self.critic(data.state, data.elapsed)
        next_value = self.critic(data.next_state, data.next_elapsed)
        target = value + gae(
            data.reward, value, next_value, data.terminated, data.done, settings.gamma, settings.lam
        )
        health = data.health.flatten(0, 1)
        if settings.arm == "central":
            psi = credit.central(target.flatten(), value.flatten(), health)
        else:
            psi = credit.min_health(target.flatten(), self._value_without_each(data), health)
        self.critic.returns.update(target.flatten()[:, None])
        return target, credit.normalized(psi, health > 0).view_as(data.health)

    def _value_without_each(self, data: Rollout) -> Float[Tensor, "TB N"]:
        """V(s with only h_i := 0) for every agent i."""
        layout = self.env.layout
        values: list[Tensor] = []
        for state, elapsed in zip(data.state, data.elapsed, strict=True):  # a step at a time, to bound memory
            copies = credit.with_each_dead(state, layout.health_columns, layout.dead_value)
            values.append(self.critic(copies, elapsed[:, None].expand(copies.shape[:2])))
        return torch.cat(values)

    def _update_actor(self, data: Rollout, psi: Float[Tensor, "T B N"]) -> dict[str, float]:
        """Ascend the clipped surrogate with entropy (eqn:surrogate_objective_clipped) on live samples."""
        settings, live = self.settings, data.health > 0
        observation, action = data.observation[live], data.action[live]
        log_prob, weight = data.log_prob[live], psi[live]
        divergence = entropy = 0.0
        for _ in range(settings.epochs):
            divergence = 0.0
            parts = torch.randperm(len(weight)).chunk(settings.minibatches)
            for part in parts:
                policy = self.actor(observation[part])
                change = policy.log_prob(action[part]).sum(-1) - log_prob[part]
                spread = policy.entropy().sum(-1).mean()
                loss = -surrogate(change, weight[part], settings.clip) - settings.entropy * spread
                _descend(self.actor_optimizer, loss, settings.max_grad_norm)
                # k3 estimator of KL(old, new): unbiased and never negative
                divergence += float((change.exp() - 1 - change).mean().detach()) / len(parts)
                entropy = float(spread.detach())
            self._follow_divergence(divergence)
        rate = self.actor_optimizer.param_groups[0]["lr"]
        return {"kl": divergence, "entropy": entropy, "actor_rate": rate}

    def _follow_divergence(self, divergence: float) -> None:
        """Keep the policy's change per rollout near ``target_kl`` by moving the learning rate."""
        group, target = self.actor_optimizer.param_groups[0], self.settings.target_kl
        factor = 1 / 1.5 if divergence > 2 * target else 1.5 if divergence < target / 2 else 1.0
        group["lr"] = float(np.clip(group["lr"] * factor, *_RATES))

    def _update_critic(self, data: Rollout, target: Float[Tensor, "T B"]) -> dict[str, float]:
        """Descend the squared error of normalised values (eqn:value_update)."""
        settings, returns = self.settings, self.critic.returns
        state, elapsed = data.state.flatten(0, 1), data.elapsed.flatten()
        aim = (target.flatten() - returns.offset) / returns.scale
        error = 0.0
        for _ in range(settings.epochs):
            parts = torch.randperm(len(aim)).chunk(settings.minibatches)
            error = 0.0
            for part in parts:
                loss = (self.critic.normalized(state[part], elapsed[part]) - aim[part]).square().mean()
                _descend(self.critic_optimizer, loss, settings.max_grad_norm)
                error += float(loss.detach()) / len(parts)
        return {"value_loss": error, "explained": 1 - error / float(aim.var())}

    def save(self, path: Path) -> None:
        """Write a checkpoint, whole or not at all."""
        content = {
            "settings": self.settings.model_dump_json(),
            "iteration": self.iteration,
            "actor": self.actor.state_dict(),
            "critic": self.critic.state_dict(),
            "actor_optimizer": self.actor_optimizer.state_dict(),
            "critic_optimizer": self.critic_optimizer.state_dict(),
            "random": torch.get_rng_state(),
            "worlds": torch.from_numpy(self.env.rows),
        }
        with replacing(path) as temporary:
            torch.save(content, temporary)

    def resume(self, path: Path) -> None:
        """Go on from a checkpoint of the same settings, as if never stopped.

        Raises:
            ResumeError: the checkpoint is of a run with other settings.
        """
        content = torch.load(path, weights_only=True)
        saved = json.loads(content["settings"])
        own = json.loads(self.settings.model_dump_json())
        changed = {key for key in own if own[key] != saved.get(key)} - {"steps"}
        if changed:
            key = min(changed)
            raise ResumeError(
                f"{path} was trained with {key} = {saved.get(key)!r}, not {own[key]!r}: choose another --out"
            )
        self.iteration = content["iteration"]
        self.actor.load_state_dict(content["actor"])
        self.critic.load_state_dict(content["critic"])
        self.actor_optimizer.load_state_dict(content["actor_optimizer"])
        self.critic_optimizer.load_state_dict(content["critic_optimizer"])
        self.step = self.env.load_rows(np.arange(self.env.num_envs), content["worlds"].numpy())
        torch.set_rng_state(content["random"])


def surrogate(change: Float[Tensor, "X"], psi: Float[Tensor, "X"], clip: float) -> Float[Tensor, ""]:
    """PPO's clipped surrogate, to be ascended (eqn:surrogate_objective_clipped without the bonus).

    Args:
        change: log of the ratio of new to old probability.
        psi: weight of each sample.
        clip: epsilon.
    """
    ratio = change.exp()
    return torch.minimum(ratio * psi, ratio.clamp(1 - clip, 1 + clip) * psi).mean()


def _descend(optimizer: torch.optim.Optimizer, loss: Tensor, max_norm: float) -> None:
    optimizer.zero_grad()
    loss.backward()
    torch.nn.utils.clip_grad_norm_([p for group in optimizer.param_groups for p in group["params"]], max_norm)
    optimizer.step()
