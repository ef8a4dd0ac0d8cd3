"""What happens when an agent fails: nothing is dropped, and failing never pays.

A batch in which a policy failed is played again world by world, so that no row depends on who shared
a batch with whom. In a world of its own a failed agent is inert to the episode's natural end, and the
episode counts as the lower of what was reached and the random anchor. An agent that fails in 5 % of
the episodes of a task did not finish it (DNF): the task counts as its floor, and the worlds that are
left are not played.
"""

from __future__ import annotations

import math
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float, Int

from hipg_bench.errors import AgentFailure
from hipg_bench.policies.policy import Policy
from hipg_bench.spec import TaskSpec

OK, NOT_PLAYED = "ok", "not_played"
"""Statuses of a row beside those of an `AgentFailure`."""
_SHARE = 20
"""One episode in so many that fails makes a DNF."""


@runtime_checkable
class Closable(Protocol):
    """A policy that holds something between calls, such as a child process.

    After ``close`` it may be used again: ``initial_state`` starts again.
    """

    def close(self) -> None:
        """Let go of it."""
        ...


def close(policy: Policy) -> None:
    """Tell a policy that its batch of worlds is over."""
    if isinstance(policy, Closable):
        policy.close()


def failures_of_a_dnf(episodes: int) -> int:
    """Fewest failed episodes that make a DNF: 5 %, rounded up."""
    return math.ceil(episodes / _SHARE)


def counted_return(spec: TaskSpec, reached: float, status: str) -> float:
    """What an episode counts: what it reached, but if it failed at most what random actions reach."""
    if status == OK:
        return reached
    return min(reached, spec.anchors.random.mean if spec.anchors else spec.floor)


class Watched:
    """A policy whose answers are checked; alone in its world, it is inert once it failed.

    Attributes:
        privileged: the policy's.
        failure: what went wrong, if anything did.
    """

    def __init__(self, policy: Policy, action_size: int, *, alone: bool) -> None:
        """Watch a policy; where it is not ``alone``, its failure is raised."""
        self.privileged = policy.privileged
        self.failure: AgentFailure | None = None
        self._policy = policy
        self._action_size = action_size
        self._alone = alone

    @property
    def status(self) -> str:
        """How the episode stands, as its row says."""
        return OK if self.failure is None else self.failure.status

    def initial_state(self, seed: int, episode_id: Int[np.ndarray, "B"], num_agents: int) -> Any:
        """The policy's memory."""
        try:
            return self._policy.initial_state(seed, episode_id, num_agents)
        except AgentFailure as failure:
            self._note(failure)

    def act(
        self, seen: np.ndarray, memory: Any, alive: Bool[np.ndarray, "B N"]
    ) -> tuple[Float[np.ndarray, "B N A"], Any]:
        """The policy's actions, or none."""
        if self.failure is None:
            try:
                action, memory = self._policy.act(seen, memory, alive)
                return checked(action, alive, self._action_size), memory
            except AgentFailure as failure:
                self._note(failure)
        return np.zeros((*alive.shape, self._action_size)), memory

    def _note(self, failure: AgentFailure) -> None:
        if not self._alone:
            raise failure
        self.failure = failure


def checked(action: Any, alive: Bool[np.ndarray, "B N"], action_size: int) -> Float[np.ndarray, "B N A"]:
    """An action of the right shape whose values for the living are finite; what the dead are told is 0.

    Raises:
        AgentFailure: it is not.
    """
    expected = (*alive.shape, action_size)
    try:
        values = np.asarray(action, np.float64)
    except (TypeError, ValueError) as error:
        raise AgentFailure("wrong_shape", f"an array of numbers {expected} is allowed: {error}") from error
    if values.shape != expected:
        raise AgentFailure(
            "wrong_shape", f"actions of shape {expected} (B, N, A) are allowed, got {values.shape}"
        )
    bad = alive[:, :, None] & ~np.isfinite(values)
    if bad.any():
        world, agent, axis = np.argwhere(bad)[0].tolist()
        raise AgentFailure(
            "not_finite",
            f"finite actions are allowed, got {values[world, agent, axis]} for agent {agent}, axis {axis}",
        )
    return values if alive.all() else np.where(alive[:, :, None], values, 0.0)
