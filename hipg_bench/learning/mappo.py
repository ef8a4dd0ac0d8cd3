"""MAPPO with any credit rule (with ``min_health``: algorithm 1 of the paper), top to bottom.

One policy, shared by all agents, acts on each agent's own observation. How the team's return becomes each
agent's weight Psi_i, and what critic that takes, is the rule's (`hipg_bench.learning.credit`).

Where the recommended settings differ from the authors' code, with every rule: dead samples are masked and
Psi is normalised over live samples only; returns are normalised instead of clipping the value's
change; truncation bootstraps, termination does not. `Settings` names each of these.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from safetensors.numpy import load_file
from safetensors.torch import save_file
from torch import Tensor

from hipg_bench.env import BatchEnv, Step
from hipg_bench.errors import BundleError
from hipg_bench.layout import TaskLayout
from hipg_bench.learning import checkpoint, credit, losses
from hipg_bench.learning.credit import CreditInputs, normalized
from hipg_bench.learning.critics import RolloutCritic
from hipg_bench.learning.gae import gae
from hipg_bench.learning.networks import Actor
from hipg_bench.learning.rollout import Rollout, roll_out
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


class Trainer:
    """Everything a run carries from one iteration to the next."""

    def __init__(self, settings: Settings, folder: Path | None = None) -> None:
        """Make worlds and networks; nothing but checkpoints is kept on disk."""
        torch.manual_seed(settings.seed)
        self.settings = settings
        self.rule = credit.find(settings.algorithm)
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

    def roll_out(self) -> Rollout:
        """Run the policy for T steps in every world."""
        data, self.step = roll_out(
            self.env, self.actor, self.step, self.settings.rollout,
            zero_dead_actions=self.settings.zero_dead_actions, keep_rows=self.rule.needs_rows,
        )  # fmt: skip
        return data

    @torch.no_grad()
    def assign_credit(self, data: Rollout) -> tuple[Float[Tensor, "T B K"], Float[Tensor, "T B N"]]:
        """Value targets (eqn:value_target), and each agent's weight Psi.

        The critic's running normalisation takes in the rollout on the way; the actor's does so after its
        update, since the ratio of new to old probabilities must be of the observations as the rollout
        normalised them.
        """
        settings = self.settings
        self.critic.update_norm(data)
        inputs = self.credit_inputs(data)
        masked = settings.mask_dead or self.rule.always_masks
        health = (data.health if masked else torch.ones_like(data.health)).flatten(0, 1)
        psi = health * self.rule.psi(inputs).flatten(0, 1)
        if settings.advantage_norm != "minibatch":
            over_live = settings.advantage_norm == "live"
            counted = health > 0 if over_live else torch.ones_like(health, dtype=torch.bool)
            psi = health.ceil() * normalized(psi, counted)
        self.critic.returns.update(inputs.target.flatten()[:, None])
        return inputs.target, psi.view_as(data.health)

    @torch.no_grad()
    def credit_inputs(self, data: Rollout) -> CreditInputs:
        """What the credit rule gets: the critic's values, and what it shall learn (eqn:value_target)."""
        settings, critic, actor = self.settings, self.critic, self.actor
        values = critic.values(data, actor)
        value, next_value = values[:-1], values[1:].clone()
        for end in data.ends:
            next_value[end.t, end.world] = critic.values(end, actor)
        ended = data.terminated if settings.bootstrap_truncation else data.done
        target = value + gae(
            self.rule.rewards(data, self.env), value, next_value, ended[..., None], data.done[..., None],
            settings.gamma, settings.gae_lambda,
        )  # fmt: skip
        return CreditInputs(data, value, target, critic, actor, self.env.layout, settings)

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
        settings, critic = self.settings, self.critic
        with torch.no_grad():
            inputs, aim, counted = critic.samples(data, target)
            aim = (aim - critic.returns.offset) / critic.returns.scale
            before = aim if settings.value_clip is None else critic.predict(*inputs)  # else not needed
        reach = settings.value_clip and settings.value_clip / float(critic.returns.scale)
        error = 0.0
        for _ in range(settings.epochs):
            parts = torch.randperm(len(aim)).chunk(settings.minibatches)
            error = 0.0
            for part in parts:
                value = critic.predict(*(one.index_select(0, part) for one in inputs))
                triple = value, before[part], aim[part]
                if counted is not None:
                    triple = tuple(one[counted[part]] for one in triple)
                loss = losses.value_loss(*triple, reach)
                self.critic_optimizer.zero_grad()
                loss.backward()
                _step(self.critic_optimizer, settings.max_grad_norm)
                error += float((triple[0].detach() - triple[2]).square().mean()) / len(parts)
        return {"value_loss": error, "explained": 1 - error / float(aim.var())}

    def start(self) -> None:
        """Begin with the weights of ``initial_policy``, if there is one.

        Raises:
            BundleError: it is no policy file, or its network is another than the settings'.
        """
        if self.settings.initial_policy:
            self.start_from_policy(Path(self.settings.initial_policy))

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

    def finish(self) -> None:
        """Nothing is left to clean up."""

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
        torch.set_rng_state(content["random"])


def networks(settings: Settings, layout: TaskLayout, *, clips: bool) -> tuple[Actor, RolloutCritic]:
    """New actor and critic of a run.

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
    return actor, credit.find(settings.algorithm).critic(settings, layout)


def _step(optimizer: torch.optim.Optimizer, max_norm: float) -> None:
    torch.nn.utils.clip_grad_norm_([p for group in optimizer.param_groups for p in group["params"]], max_norm)
    optimizer.step()
