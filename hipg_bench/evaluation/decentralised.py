"""Whether agents act on their own observations alone: found by replay, not believed.

Declared networks and ONNX graphs are run per agent, so they cannot do otherwise. Code of others is given
the whole team at once. Here a batch is played as it is for the score and recorded. Then it is replayed in a
fresh process: in every world one agent observes what it did before, and its team-mates observe what they
did in other worlds. An agent that needs nobody else answers the same. The number of worlds, the seeds and
who is alive look like those of any batch, so that code which behaves only while it is looked at has little
to go by; what remains is that team-mates' observations do not fit together.
"""

from __future__ import annotations

import dataclasses
import secrets
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from hipg_bench.errors import AgentFailure
from hipg_bench.evaluation.episodes import EvaluationJob
from hipg_bench.evaluation.failures import close
from hipg_bench.policies.policy import Policy
from hipg_bench.spec import TaskSpec

TOLERANCE = 2.0**-16
"""Actions are rounded to this grid; the last bits of a matrix product may move them by one step of it."""


@dataclasses.dataclass(frozen=True)
class Difference:
    """An action that was another one when team-mates observed something else.

    Attributes:
        episode_id: in which episode of the evaluation seed.
        agent: whose.
        step: when, the first time.
        size: largest difference of a coordinate; infinite if it failed.
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
        """Whether every agent acted on what it observed itself."""
        return self.compared > 0 and not self.differences

    def __str__(self) -> str:
        if self.decentralised:
            return f"decentralised: {self.compared} actions did not depend on what team-mates observed"
        if not self.differences:
            return "not known to be decentralised: its batch failed, and nothing could be compared"
        worst = max(self.differences, key=lambda difference: difference.size)
        return (
            f"centralised: {len(self.differences)} agents acted on more than they observed; agent "
            f"{worst.agent} of episode {worst.episode_id} differs by {worst.size:.3g} from step {worst.step} "
            f"on where its team-mates observe something else"
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


_REPLAYS = 4
"""Times that a batch is replayed, each time with another agent of every world."""


def verify(spec: TaskSpec, policy: Policy, job: EvaluationJob, worlds: Sequence[int]) -> Verdict:
    """Play a batch of worlds, then replay it with other team-mates' observations, and compare.

    What an agent does rarely may not occur: a verdict of ``decentralised`` is no proof.

    Args:
        spec: the task.
        policy: acts on observations; all agents at once.
        job: how worlds are made.
        worlds: which, two or more of one evaluation seed; as many as in a scored batch.
    """
    recorder = _Recorder(policy)
    job.play(spec, recorder, list(worlds))
    rng = np.random.default_rng(secrets.randbits(64))
    compared = 0
    found: dict[tuple[int, int], Difference] = {}
    for record in recorder.records:
        if len(record.episode_id) < 2:
            continue  # played world by world, since the batch failed
        # an order for each world by itself: agents that share between worlds are not always both unchanged
        order = np.stack([rng.permutation(record.num_agents) for _ in record.episode_id])
        for target in order.T[:_REPLAYS]:
            sizes = _replay(policy, record, target, rng)
            compared += int(np.isfinite(sizes).sum())
            for b, agent in enumerate(target.tolist()):
                bad = np.flatnonzero(np.nan_to_num(sizes[:, b]) > TOLERANCE)
                if len(bad):
                    episode = int(record.episode_id[b])
                    worst = float(np.nanmax(sizes[:, b]))
                    found[episode, agent] = Difference(episode, agent, int(bad[0]), worst)
    return Verdict(compared, tuple(found.values()))


def _replay(
    policy: Policy, record: _Record, target: Int[np.ndarray, "B"], rng: np.random.Generator
) -> Float[np.ndarray, "T B"]:
    """How much each world's target acts otherwise, step by step; NaN from its death on.

    If the policy fails, the differences are infinite from then on.
    """
    steps, worlds = len(record.seen), len(target)
    sizes = np.full((steps, worlds), np.nan)
    here = np.arange(worlds)
    # every team-mate's stream is that of the same agent in another world
    source = (here[:, None] + rng.integers(1, worlds, size=(worlds, record.num_agents))) % worlds
    source[here, target] = here
    agents = np.arange(record.num_agents)
    living = np.ones(worlds, bool)
    t = 0
    try:
        memory = policy.initial_state(record.seed, record.episode_id, record.num_agents)
        for t in range(steps):
            seen, alive = record.seen[t][source, agents], record.alive[t][source, agents]
            living &= alive[here, target]
            if not living.any():
                break
            answer, memory = policy.act(seen, memory, alive)
            apart = np.abs(answer[here, target] - record.action[t][here, target]).max(axis=-1)
            sizes[t, living] = apart[living]
    except AgentFailure:
        sizes[t:, living] = np.inf
    finally:
        close(policy)
    return sizes
