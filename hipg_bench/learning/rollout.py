"""Rollouts: a policy acts for T steps in B worlds."""

from __future__ import annotations

import dataclasses

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from hipg_bench.env import BatchEnv, Step
from hipg_bench.learning.networks import Actor


@dataclasses.dataclass
class Rollout:
    """T steps of B worlds. Observations and states have one row more: what the last step led to.

    Attributes:
        health: h_i before each step, in [0, 1].
        action: what each agent did.
        log_prob: of the action as drawn.
        reward: of the team.
        terminated: the episode ended by the task's rules.
        done: the episode ended, perhaps by its horizon.
        observation: of each agent, as it acts on it.
        state: the joint state.
        elapsed: share of the horizon that has passed.
        ends: what steps led to where they ended an episode; there the next row is another episode's.
        episodes: metrics of the episodes that ended.
        rows: the worlds before each step, where they were kept, else empty.
    """

    health: Float[Tensor, "T B N"]
    action: Float[Tensor, "T B N A"]
    log_prob: Float[Tensor, "T B N"]
    reward: Float[Tensor, "T B"]
    terminated: Bool[Tensor, "T B"]
    done: Bool[Tensor, "T B"]
    observation: Float[Tensor, "T+1 B N O"]
    state: Float[Tensor, "T+1 B S"]
    elapsed: Float[Tensor, "T+1 B"]
    ends: list[End]
    episodes: list[dict[str, float]]
    rows: list[Float[np.ndarray, "B R"]]


@dataclasses.dataclass
class End:
    """What the t-th step led to in M worlds whose episode it ended."""

    t: int
    world: Int[Tensor, "M"]
    observation: Float[Tensor, "M N O"]
    state: Float[Tensor, "M S"]
    elapsed: Float[Tensor, "M"]


@torch.no_grad()
def roll_out(
    env: BatchEnv,
    actor: Actor,
    step: Step,
    length: int,
    *,
    zero_dead_actions: bool = False,
    keep_rows: bool = False,
) -> tuple[Rollout, Step]:
    """Let a policy act in every world.

    Args:
        env: B worlds.
        actor: the policy; its actions are drawn from torch's global generator.
        step: what the last step of ``env`` returned, or its reset.
        length: T.
        zero_dead_actions: store zeros as the actions of dead agents, beside the log-probability of what was
            drawn.
        keep_rows: keep the worlds before each step.

    Returns:
        The rollout, and the last step's result, with which the next rollout begins.
    """
    T, B, N, horizon = length, env.num_envs, env.num_agents, env.spec.horizon  # noqa: N806
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
        rows=[],
    )
    for t in range(T):
        _record_observation(data, t, step, horizon)
        if keep_rows:
            data.rows.append(env.rows)
        data.health[t] = torch.from_numpy(step.info["health"])
        policy = actor(data.observation[t])
        data.action[t] = policy.sample()
        data.log_prob[t] = policy.log_prob(data.action[t]).sum(-1)
        step = env.step(data.action[t].numpy())
        if zero_dead_actions:
            data.action[t][data.health[t] == 0] = 0.0
        data.reward[t] = torch.from_numpy(step.reward)
        data.terminated[t] = torch.from_numpy(step.terminated)
        data.done[t] = torch.from_numpy(step.terminated | step.truncated)
        if data.done[t].any():
            _record_ends(data, t, step, horizon)
    _record_observation(data, T, step, horizon)
    return data, step


def _record_observation(data: Rollout, t: int, step: Step, horizon: int) -> None:
    data.observation[t] = torch.from_numpy(step.observation)
    data.state[t] = torch.from_numpy(step.info["state"])
    data.elapsed[t] = torch.from_numpy(step.info["elapsed"]) / horizon


def _record_ends(data: Rollout, t: int, step: Step, horizon: int) -> None:
    """Record what was observed last in the episodes that the t-th step ended, and their metrics."""
    (over,), info = data.done[t].nonzero(as_tuple=True), step.info
    observed = torch.from_numpy(info["final_observation"]), torch.from_numpy(info["final_state"])
    data.ends.append(End(t, over, *observed, data.elapsed[t, over] + 1 / horizon))
    for b in over.tolist():
        data.episodes.append({name: float(values[b]) for name, values in info["metrics"].items()})
