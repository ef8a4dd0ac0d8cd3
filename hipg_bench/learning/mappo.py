"""MAPPO with min-health crediting (algorithm 1 of the paper), top to bottom.

One policy, shared by all agents, acts on each agent's own observation; the critic sees the joint
state, health included, or in the algorithm ``local`` each agent's own observation. What sets the algorithms
apart is `Trainer.assign_credit`: how the team's advantage becomes each agent's weight Psi_i.

Where the recommended settings differ from the authors' code, in every algorithm: dead samples are masked and
Psi is normalised over live samples only; returns are normalised instead of clipping the value's
change; truncation bootstraps, termination does not. `Settings` names each of these.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from safetensors.numpy import load_file
from safetensors.torch import save_file
from torch import Tensor

from hipg_bench.env import BatchEnv, Step
from hipg_bench.errors import BundleError
from hipg_bench.layout import TaskLayout
from hipg_bench.learning import checkpoint, credit, losses
from hipg_bench.learning.forks import Forks
from hipg_bench.learning.gae import gae
from hipg_bench.learning.networks import Actor, Critic
from hipg_bench.learning.settings import Settings
from hipg_bench.paths import replacing
from hipg_bench.policies.network import AttentionSpec, NetworkSpec, load_network, save_network
from hipg_bench.registry import make

_RATES = (1e-5, 2e-3)
"""Bounds of the actor's learning rate."""
_ENTROPY_COEFS = (1e-5, 0.1)
"""Bounds of the entropy bonus where it follows ``target_entropy``."""
_START_COUNTS = 20
"""Rollouts that the normalisation of a start weighs."""
_PIECE = 4096
"""Samples whose gradient is taken at once: what passes between layers stays in the processor's cache."""
_LOSE_EVERY = 5
"""Steps between two chances of a spontaneous death; each costs another look at all worlds."""


@dataclasses.dataclass
class Rollout:
    """T steps of B worlds. Of what is seen, the row after the last is what they led to."""

    health: Float[Tensor, "T B N"]
    action: Float[Tensor, "T B N A"]
    log_prob: Float[Tensor, "T B N"]
    reward: Float[Tensor, "T B"]
    terminated: Bool[Tensor, "T B"]
    done: Bool[Tensor, "T B"]
    observation: Float[Tensor, "T+1 B N O"]
    state: Float[Tensor, "T+1 B S"]
    elapsed: Float[Tensor, "T+1 B"]  # share of the horizon
    ends: list[End]  # where the next row is not what a step led to
    episodes: list[dict[str, float]]  # metrics of those that ended


@dataclasses.dataclass
class End:
    """What the t-th step led to in M worlds whose episode it ended."""

    t: int
    world: Int[Tensor, "M"]
    observation: Float[Tensor, "M N O"]
    state: Float[Tensor, "M S"]
    elapsed: Float[Tensor, "M"]


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
            dead_observation=settings.dead_observation,
        )
        self.entropy_coef = settings.entropy_coef
        self.actor, self.critic = networks(settings, self.env.layout, clips=self.env.spec.clip_actions)
        self.actor_optimizer = torch.optim.Adam(self.actor.parameters(), settings.actor_rate, eps=1e-5)
        self.critic_optimizer = torch.optim.Adam(self.critic.parameters(), settings.critic_rate, eps=1e-5)
        self.iteration = 0
        self.step: Step = self.env.reset()
        self.forks = Forks(settings, self.env) if settings.forks and settings.algorithm != "local" else None

    def iterate(self) -> dict[str, float]:
        """One round of algorithm 1: roll out, value targets, credit, update. Returns what to log."""
        data = self.roll_out()
        target, psi = self.assign_credit(data)
        log = self.update(data, target, psi)
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
            health=torch.empty(T, B, N),
            action=torch.empty(T, B, N, env.action_size),
            log_prob=torch.empty(T, B, N),
            reward=torch.empty(T, B),
            terminated=torch.empty(T, B, dtype=torch.bool),
            done=torch.empty(T, B, dtype=torch.bool),
            observation=torch.empty(T + 1, B, N, env.observation_size),
            state=torch.empty(T + 1, B, env.state_size),
            elapsed=torch.empty(T + 1, B),
            ends=[],
            episodes=[],
        )
        for t in range(T):
            self._look(data, t)
            if settings.spontaneous_deaths and t % _LOSE_EVERY == 0:
                self._lose_some(data, t)
            data.health[t] = torch.from_numpy(self.step.info["health"])
            policy = self.actor(data.observation[t])
            data.action[t] = policy.sample()
            data.log_prob[t] = policy.log_prob(data.action[t]).sum(-1)
            now = self.step = env.step(data.action[t].numpy())
            if self.forks is not None:
                self.forks.play(self.actor, env)
            if settings.zero_dead_actions:
                data.action[t][data.health[t] == 0] = 0.0
            data.reward[t] = torch.from_numpy(now.reward)
            data.terminated[t] = torch.from_numpy(now.terminated)
            data.done[t] = torch.from_numpy(now.terminated | now.truncated)
            if data.done[t].any():
                self._note_end(data, t)
        self._look(data, T)
        return data

    def _look(self, data: Rollout, t: int) -> None:
        """Write what is seen now."""
        now = self.step
        data.observation[t] = torch.from_numpy(now.observation)
        data.state[t] = torch.from_numpy(now.info["state"])
        data.elapsed[t] = torch.from_numpy(now.info["elapsed"]) / self.env.spec.horizon

    def _note_end(self, data: Rollout, t: int) -> None:
        """Write what was last seen of episodes that the t-th step ended, and their metrics."""
        (over,), info = data.done[t].nonzero(as_tuple=True), self.step.info
        seen = torch.from_numpy(info["final_observation"]), torch.from_numpy(info["final_state"])
        data.ends.append(End(t, over, *seen, data.elapsed[t, over] + 1 / self.env.spec.horizon))
        for b in over.tolist():
            data.episodes.append({name: float(values[b]) for name, values in info["metrics"].items()})

    def _lose_some(self, data: Rollout, t: int) -> None:
        """Kill agents without a cause: the critic is asked about teams without agent i, and so meets such.

        What was learned before must not pay for it: the episode ends there, and another goes on.
        """
        env = self.env
        chance = self.settings.spontaneous_deaths * _LOSE_EVERY / (env.spec.horizon * env.num_agents)
        struck = torch.rand(env.num_envs, env.num_agents) < chance
        worlds = torch.nonzero(struck.any(1))[:, 0].numpy()
        if not len(worlds):
            return
        rows = env.rows
        for agent in range(env.num_agents):
            chosen = struck[:, agent].numpy()
            rows[chosen] = env.fork(rows[chosen], {agent: 0.0})
        self.step = env.load_rows(worlds, rows[worlds])
        if t > 0:
            (cut,) = (struck.any(1) & ~data.done[t - 1]).nonzero(as_tuple=True)
            seen = data.observation[t, cut], data.state[t, cut], data.elapsed[t, cut]
            data.ends.append(End(t - 1, cut, *seen))
            data.done[t - 1, cut] = True
        self._look(data, t)

    @torch.no_grad()
    def assign_credit(self, data: Rollout) -> tuple[Float[Tensor, "T B K"], Float[Tensor, "T B N"]]:
        """Value targets (eqn:value_target), and each agent's weight Psi (the algorithm).

        There are K = N critics' views in the algorithm ``local``, else K = 1. The critic's running
        normalisation takes in the rollout on the way; the actor's does so after its update, since the ratio
        of new to old probabilities must be of the observations as the rollout normalised them.
        """
        settings = self.settings
        self.critic.norm.update(self._shown(data)[0][:-1].flatten(0, -2))
        value, target = self.value_targets(data)
        masked = settings.mask_dead or settings.algorithm == "min_health"
        health = (data.health if masked else torch.ones_like(data.health)).flatten(0, 1)
        if settings.algorithm == "min_health":
            psi = credit.min_health(target.flatten(0, 1), self.value_without_each(data), health)
        else:
            psi = credit.advantage(target.flatten(0, 1), value.flatten(0, 1), health)
        if settings.advantage_norm != "minibatch":
            counted = (
                health > 0 if settings.advantage_norm == "live" else torch.ones_like(health, dtype=torch.bool)
            )
            psi = health.ceil() * credit.normalized(psi, counted)
        self.critic.returns.update(target.flatten()[:, None])
        return target, psi.view_as(data.health)

    def value_targets(self, data: Rollout) -> tuple[Float[Tensor, "T B K"], Float[Tensor, "T B K"]]:
        """The critic's values, and what it shall learn (eqn:value_target)."""
        settings = self.settings
        values = self.critic(*self._shown(data))
        value, next_value = values[:-1], values[1:].clone()
        for end in data.ends:
            next_value[end.t, end.world] = self.critic(*self._shown(end))
        ended = data.terminated if settings.bootstrap_truncation else data.done
        return value, value + gae(
            data.reward[..., None], value, next_value, ended[..., None], data.done[..., None],
            settings.gamma, settings.gae_lambda,
        )  # fmt: skip

    def _shown(self, view: Rollout | End) -> tuple[Float[Tensor, "*T B K F"], Float[Tensor, "*T B K"]]:
        """What the algorithm's critic is shown: the joint state, or every agent's own observation."""
        seen = view.observation if self.settings.algorithm == "local" else view.state[..., None, :]
        return seen, view.elapsed[..., None].expand(seen.shape[:-1])

    def value_without_each(self, data: Rollout) -> Float[Tensor, "TB N"]:
        """V(s with only h_i := 0) for every agent i."""
        layout = self.env.layout
        values: list[Tensor] = []
        for state, elapsed in zip(
            data.state[:-1], data.elapsed[:-1], strict=True
        ):  # by steps, to bound memory
            copies = credit.with_each_dead(state, layout.health_columns, layout.dead_value)
            values.append(self.critic(copies, elapsed[:, None].expand(copies.shape[:2])))
        return torch.cat(values)

    def update(
        self, data: Rollout, target: Float[Tensor, "T B K"], psi: Float[Tensor, "T B N"]
    ) -> dict[str, float]:
        """Improve actor and critic on a rollout. Returns what to log."""
        log = self._update_actor(data, psi) | self._update_critic(data, target)
        self.actor.norm.update(data.observation[:-1][data.health > 0])
        return log

    def _update_actor(self, data: Rollout, psi: Float[Tensor, "T B N"]) -> dict[str, float]:
        """Ascend the clipped surrogate with entropy (eqn:surrogate_objective_clipped)."""
        settings = self.settings
        used = data.health > 0 if settings.mask_dead else torch.ones_like(data.health, dtype=torch.bool)
        with torch.no_grad():
            observation = self.actor.norm(data.observation[:-1][used])
        action, log_prob, weight = data.action[used], data.log_prob[used], psi[used]
        divergence = entropy = 0.0
        for _ in range(settings.epochs):
            divergence = 0.0
            for part in torch.randperm(len(weight)).chunk(settings.minibatches):
                credited = weight[part]
                if settings.advantage_norm == "minibatch":
                    credited = (credited - credited.mean()) / (credited.std() + 1e-8)
                self.actor_optimizer.zero_grad()
                for piece, psi_of in zip(part.split(_PIECE), credited.split(_PIECE), strict=True):
                    policy = self.actor.distribution(observation.index_select(0, piece))
                    change = policy.log_prob(action[piece]).sum(-1) - log_prob[piece]
                    spread = policy.entropy().sum(-1).mean()
                    loss = -losses.surrogate(change, psi_of, settings.clip) - self.entropy_coef * spread
                    (loss * (len(piece) / len(part))).backward()
                    # k3 estimator of KL(old, new): unbiased and never negative
                    divergence += float((change.exp() - 1 - change).sum().detach()) / len(weight)
                    entropy = float(spread.detach())
                _step(self.actor_optimizer, settings.max_grad_norm)
            self._follow_divergence(divergence)
        self._follow_entropy(entropy / self.env.action_size)
        rate = self.actor_optimizer.param_groups[0]["lr"]
        return {
            "kl": divergence, "entropy": entropy, "actor_rate": rate, "entropy_coef": self.entropy_coef,
        }  # fmt: skip

    def _follow_divergence(self, divergence: float) -> None:
        """Keep the policy's change per rollout near ``target_kl`` by moving the learning rate."""
        group, target = self.actor_optimizer.param_groups[0], self.settings.target_kl
        if target is None:
            return
        factor = 1 / 1.5 if divergence > 2 * target else 1.5 if divergence < target / 2 else 1.0
        group["lr"] = float(np.clip(group["lr"] * factor, *_RATES))

    def _follow_entropy(self, entropy: float) -> None:
        """Keep the policy's entropy per action coordinate near ``target_entropy`` by moving the bonus."""
        target = self.settings.target_entropy
        if target is not None:
            factor = 1.1 if entropy < target else 1 / 1.1
            self.entropy_coef = float(np.clip(self.entropy_coef * factor, *_ENTROPY_COEFS))

    def _update_critic(self, data: Rollout, target: Float[Tensor, "T B K"]) -> dict[str, float]:
        """Descend the squared error of normalised values (eqn:value_update)."""
        settings, returns = self.settings, self.critic.returns
        seen, elapsed = self._shown(data)
        with torch.no_grad():
            inputs = self.critic.inputs(seen[:-1], elapsed[:-1]).flatten(0, -2)
            aim = (target.flatten() - returns.offset) / returns.scale
            if self.forks is not None:
                state, when, value = self.forks.harvest(self.critic)
                inputs = torch.cat([inputs, self.critic.inputs(state, when).flatten(0, -2)])
                aim = torch.cat([aim, (value.flatten() - returns.offset) / returns.scale])
            before = self.critic.normalized(inputs)
        reach = settings.value_clip and settings.value_clip / float(returns.scale)
        error = 0.0
        for _ in range(settings.epochs):
            parts = torch.randperm(len(aim)).chunk(settings.minibatches)
            error = 0.0
            for part in parts:
                value = self.critic.normalized(inputs.index_select(0, part))
                loss = losses.value_loss(value, before[part], aim[part], reach)
                self.critic_optimizer.zero_grad()
                loss.backward()
                _step(self.critic_optimizer, settings.max_grad_norm)
                error += float((value.detach() - aim[part]).square().mean()) / len(parts)
        return {"value_loss": error, "explained": 1 - error / float(aim.var())}

    def start_from_policy(self, path: Path) -> None:
        """Begin with a policy file's weights.

        Raises:
            BundleError: it is none, or its network is another than the settings'.
        """
        spec = load_network(path).spec  # nothing in the file is believed before it is checked
        if spec != self.actor.spec:
            raise BundleError(f"{path}: a start must declare this run's {self.actor.spec!r}, got {spec!r}")
        settings = self.settings
        samples = settings.num_envs * settings.rollout * self.env.num_agents
        self.actor.adopt(load_file(path), _START_COUNTS * samples)

    def save_policy(self, path: Path) -> None:
        """Write the policy file: the mean action's network."""
        save_network(self.actor.tensors(), path, self.actor.spec)

    def save_networks(self, path: Path) -> None:
        """Write actor and critic with all they normalise by, as safetensors: what an audit needs."""
        parts = {"actor": self.actor, "critic": self.critic}
        tensors = {
            f"{part}.{name}": tensor.contiguous()
            for part, network in parts.items()
            for name, tensor in network.state_dict().items()
        }
        with replacing(path) as temporary:
            save_file(tensors, temporary, {"settings": self.settings.model_dump_json()})

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
            "entropy_coef": self.entropy_coef,
        }
        if self.forks is not None:
            content["forks"] = torch.from_numpy(self.forks.env.rows)
        checkpoint.save(path, content)

    def resume(self, path: Path) -> None:
        """Go on from a checkpoint of the same settings, as if never stopped.

        Raises:
            ResumeError: the checkpoint is of a run with other settings, or damaged.
        """
        content = checkpoint.load(path)
        self.settings.check_resumes(content["settings"], path)
        self.iteration = content["iteration"]
        self.entropy_coef = content.get("entropy_coef", self.settings.entropy_coef)
        self.actor.load_state_dict(content["actor"])
        self.critic.load_state_dict(content["critic"])
        self.actor_optimizer.load_state_dict(content["actor_optimizer"])
        self.critic_optimizer.load_state_dict(content["critic_optimizer"])
        self.step = self.env.load_rows(np.arange(self.env.num_envs), content["worlds"].numpy())
        if self.forks is not None:
            self.forks.go_on(content["forks"].numpy())
        torch.set_rng_state(content["random"])


def networks(settings: Settings, layout: TaskLayout, *, clips: bool) -> tuple[Actor, Critic]:
    """Fresh actor and critic for a run.

    Args:
        settings: of the run.
        layout: of the task's vectors.
        clips: whether the task clips actions; where it does not, the exported policy must not either.
    """
    head = "mean" if clips else "linear"
    groups = settings.attention_groups
    actor = Actor(
        layout.observation.size,
        layout.action.size,
        settings.actor_hidden,
        settings.initial_std,
        spec=AttentionSpec.of(layout.observation, *groups, head=head) if groups else NetworkSpec(head=head),
        normalize=settings.normalize_inputs,
    )
    local = settings.algorithm == "local"
    critic = Critic(
        layout.observation.size if local else layout.state.size,
        settings.critic_hidden,
        np.empty(0, np.int64) if local else layout.health_columns,
        normalize=settings.normalize_inputs,
        normalize_returns=settings.normalize_returns,
    )
    return actor, critic


def _step(optimizer: torch.optim.Optimizer, max_norm: float) -> None:
    torch.nn.utils.clip_grad_norm_([p for group in optimizer.param_groups for p in group["params"]], max_norm)
    optimizer.step()
