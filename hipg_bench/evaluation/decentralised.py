"""Whether agents act on their own observations alone: found by replay, not believed.

Declared networks and ONNX graphs are run per agent, so they cannot do otherwise. Code of others is given
the whole team at once. Here worlds are played and recorded; then each agent's stream of observations is
replayed in a fresh process where all other agents are dead and unseen and there is no other world. An
agent that needs nobody else answers the same.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from hipg_bench.errors import AgentFailure
from hipg_bench.evaluation.episodes import Plan
from hipg_bench.evaluation.failures import close
from hipg_bench.policies.policy import Policy
from hipg_bench.spec import TaskSpec

TOLERANCE = 2.0**-16
"""Actions are rounded to this grid; the last bits of a matrix product may move them by one step of it."""


@dataclasses.dataclass(frozen=True)
class Difference:
    """An action that was another one when the agent was alone.

    Attributes:
        episode_id: in which episode of the evaluation seed.
        agent: whose.
        step: when, the first time.
        size: largest difference of a coordinate; infinite if it failed alone.
    """

    episode_id: int
    agent: int
    step: int
    size: float


@dataclasses.dataclass(frozen=True)
class Verdict:
    """What the replay showed.

    Attributes:
        compared: actions that were compared, one per agent and step.
        differences: the first one of each stream that has any.
    """

    compared: int
    differences: tuple[Difference, ...]

    @property
    def decentralised(self) -> bool:
        """Whether every agent acted as it does alone."""
        return not self.differences

    def __str__(self) -> str:
        if self.decentralised:
            return f"decentralised: {self.compared} actions were the same alone"
        worst = max(self.differences, key=lambda difference: difference.size)
        return (
            f"centralised: {len(self.differences)} agents acted on more than they observed; alone, "
            f"agent {worst.agent} of episode {worst.episode_id} differs by {worst.size:.3g} "
            f"from step {worst.step} on"
        )


@dataclasses.dataclass
class _Record:
    """What a policy was shown and answered, step by step."""

    seed: int
    episode_id: Int[np.ndarray, "B"]
    num_agents: int
    seen: list[Float[np.ndarray, "B N O"]]
    alive: list[Bool[np.ndarray, "B N"]]
    action: list[Float[np.ndarray, "B N A"]]


class _Recorder:
    """A policy whose last episodes are kept."""

    privileged = False

    def __init__(self, policy: Policy) -> None:
        self._policy = policy
        self.records: list[_Record] = []

    def initial_state(self, seed: int, episode_id: Int[np.ndarray, "B"], num_agents: int) -> Any:
        self.records.append(_Record(seed, episode_id, num_agents, [], [], []))
        return self._policy.initial_state(seed, episode_id, num_agents)

    def act(
        self, seen: np.ndarray, memory: Any, alive: Bool[np.ndarray, "B N"]
    ) -> tuple[Float[np.ndarray, "B N A"], Any]:
        action, memory = self._policy.act(seen, memory, alive)
        record = self.records[-1]
        record.seen.append(seen.copy())
        record.alive.append(alive.copy())
        record.action.append(action.copy())
        return action, memory

    def close(self) -> None:
        close(self._policy)


def verify(spec: TaskSpec, policy: Policy, plan: Plan, worlds: Sequence[int] = (0, 1)) -> Verdict:
    """Play some worlds together, then every agent of them alone, and compare.

    Two worlds show an agent that carries something from one world to another. What an agent does rarely
    may not occur in them: a verdict of ``decentralised`` is no proof.

    Args:
        spec: the task.
        policy: acts on observations; all agents at once.
        plan: how worlds are made.
        worlds: which, of one evaluation seed.
    """
    recorder = _Recorder(policy)
    plan.play(spec, recorder, list(worlds))
    compared = 0
    differences: list[Difference] = []
    for record in recorder.records:
        for b in range(len(record.episode_id)):
            for agent in range(record.num_agents):
                sizes = list(_replay(policy, record, b, agent))
                compared += len(sizes)
                bad = np.flatnonzero(np.array(sizes) > TOLERANCE)
                if len(bad):
                    episode = int(record.episode_id[b])
                    differences.append(Difference(episode, agent, int(bad[0]), max(sizes)))
    return Verdict(compared, tuple(differences))


def _replay(policy: Policy, record: _Record, b: int, agent: int) -> Iterator[float]:
    """How much the agent's actions differ when it is alone, step by step, while it lives."""
    try:
        memory = policy.initial_state(record.seed, record.episode_id[b : b + 1], record.num_agents)
        for seen, alive, action in zip(record.seen, record.alive, record.action, strict=True):
            if not alive[b, agent]:
                return
            own = np.zeros_like(seen[:1])
            own[0, agent] = seen[b, agent]
            only = np.zeros((1, record.num_agents), bool)
            only[0, agent] = True
            answer, memory = policy.act(own, memory, only)
            yield float(np.abs(answer[0, agent] - action[b, agent]).max())
    except AgentFailure:
        yield np.inf
    finally:
        close(policy)
