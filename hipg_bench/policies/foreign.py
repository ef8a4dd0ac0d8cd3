"""Policies whose code or file comes from others: they run in a locked child process and answer over pipes."""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import time
import weakref
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from hipg_bench import registry
from hipg_bench.errors import AgentFailure, HostFailure
from hipg_bench.layout import Layout
from hipg_bench.sandbox import choice
from hipg_bench.sandbox.budget import PROTOCOL, Budget
from hipg_bench.sandbox.process import Child
from hipg_bench.spec import TaskSpec

_GRID = 2.0**16
"""Actions are rounded to 2^-16, as those of declared networks: their last bits may depend on the batch."""
_SPARE = 4
"""An answer may be so many times as long as it should be and is still read, to say what is wrong with it."""


@dataclasses.dataclass
class Session:
    """The child that plays some episodes, from their start on.

    It is a process, so a `ForeignPolicy` is pure in appearance only: the memory it returns is the one it got.
    The child is killed when the session is dropped.

    Attributes:
        child: the process.
        bank: s left of what the episodes' steps may take beyond their time, in all.
    """

    child: Child
    bank: float


class ForeignPolicy:
    """An agent in a sandboxed child; a fresh one for every call of `initial_state`.

    The next child is started early, to the point where it would load the agent, and waits.

    Attributes:
        privileged: it acts on observations.
        sandbox: how the child is locked in: ``bubblewrap``, ``landlock``, or ``none``.
    """

    privileged = False

    def __init__(
        self,
        spec: TaskSpec,
        folder: Path,
        train_seed: int,
        *,
        runner: str,
        options: Mapping[str, Any],
        trust: bool = False,
        budget: Budget = PROTOCOL,
    ) -> None:
        """Choose a sandbox; nothing is started yet.

        Args:
            spec: the task.
            folder: the submission's; every child sees a copy of its own, read-only.
            train_seed: told to the agent.
            runner: the module of `sandbox.inside` that makes the agent, e.g. ``python_runner``.
            options: what that module wants to know, e.g. ``{"entry_point": "my_agent:make_agent"}``.
            trust: run without a sandbox: the agent can do whatever you can.
            budget: limits of the child.

        Raises:
            SandboxError: no sandbox works here, and the agent is not trusted.
        """
        self.sandbox = choice.NONE if trust else choice.sandbox()
        self._folder = folder
        self._budget = budget
        self._playing: weakref.WeakSet[Child] = weakref.WeakSet()
        self._next: Child | None = None
        self._action_size = registry.definition_of(spec).layout.action.size
        self._setup = told(spec, train_seed, runner, options)

    def initial_state(self, seed: int, episode_id: Int[np.ndarray, "B"], num_agents: int) -> Session:
        """Start a child, let it make its agent and begin B episodes.

        Raises:
            AgentFailure: it does not get that far in time.
            HostFailure: the child could not be started, twice.
        """
        seeds = agent_seeds(seed, episode_id).tobytes()
        try:
            child = self._begin(seeds)
        except HostFailure:  # not the agent's fault: once more
            child = self._begin(seeds)
        with contextlib.suppress(HostFailure):
            self._next = self._child()  # Python starts while this one plays
        return Session(child, self._budget.bank)

    def close(self) -> None:
        """End the children that play."""
        for child in self._playing:
            child.kill()

    def _begin(self, seeds: bytes) -> Child:
        child = self._next or self._child()
        self._next = None
        self._playing.add(child)
        child.ask({"do": "reset"}, [seeds], self._budget.start_up)
        return child

    def _child(self) -> Child:
        return Child(choice.BACKENDS[self.sandbox], self._folder, self._setup, self._budget)

    def act(
        self, observation: Float[np.ndarray, "B N O"], memory: Session, alive: Bool[np.ndarray, "B N"]
    ) -> tuple[Float[np.ndarray, "B N A"], Session]:
        """Ask the child; what it answers for the dead is ignored.

        Raises:
            AgentFailure: it crashed, took too long, or answered with no actions.
        """
        worlds = len(alive)
        shape = (*alive.shape, self._action_size)
        started = time.monotonic()
        header, payload = memory.child.ask(
            {"do": "act", "shape": observation.shape},
            [np.ascontiguousarray(observation, np.float32).data, np.ascontiguousarray(alive).data],
            self._budget.deadline(worlds),
            most=_SPARE * 8 * int(np.prod(shape)),
        )
        memory.bank -= self._budget.overtime(worlds, time.monotonic() - started)
        if memory.bank < 0:
            memory.child.kill()
            raise AgentFailure(
                "timeout",
                f"steps of more than {self._budget.soft} s took more than {self._budget.bank} s beyond that",
            )
        action = _action(header, payload, shape)
        action[~alive] = 0.0
        if not np.isfinite(action).all():
            world, agent, axis = np.argwhere(~np.isfinite(action))[0].tolist()
            memory.child.kill()
            raise AgentFailure(
                "not_finite", f"world {world}, agent {agent}, action {axis} is {action[world, agent, axis]}"
            )
        return np.round(action * _GRID) / _GRID, memory


def told(spec: TaskSpec, train_seed: int, runner: str, options: Mapping[str, Any]) -> dict[str, Any]:
    """What a child is told: which module of `sandbox.inside` runs, and which task it is for."""
    layout = registry.definition_of(spec).layout
    return {
        "runner": runner,
        "options": dict(options),
        "train_seed": train_seed,
        "task": {
            "name": spec.task,
            "num_agents": spec.num_agents,
            "observation_size": layout.observation.size,
            "action_size": layout.action.size,
            "horizon": spec.horizon,
            "control_step": spec.control_step,
            "observation": _blocks(layout.observation),
            "action": _blocks(layout.action),
        },
    }


def agent_seeds(seed: int, episode_id: Int[np.ndarray, "B"]) -> Int[np.ndarray, "B"]:
    """Seeds for the agent's own chance, one per world.

    They are hashes: of a hidden evaluation seed they tell nothing, and they are no seed of an environment.
    """
    keys = [f"hipg agent|{seed}|{episode}".encode() for episode in np.asarray(episode_id).tolist()]
    digests = [hashlib.sha256(key).digest()[:8] for key in keys]
    return np.array([int.from_bytes(digest, "little") >> 1 for digest in digests], np.int64)


def _action(
    header: Mapping[str, Any], payload: memoryview, shape: tuple[int, ...]
) -> Float[np.ndarray, "B N A"]:
    """The answer as an array of its own.

    Raises:
        AgentFailure: it has another shape.
    """
    said = header.get("shape")
    if said != list(shape) or payload.nbytes != 8 * int(np.prod(shape)):
        got = f"shape {said}" if said else f"{header.get('kind')}, which is no array of numbers"
        raise AgentFailure("wrong_shape", f"actions have shape {list(shape)} (B, N, A), got {got:.100}")
    return np.frombuffer(payload, np.float64).reshape(shape).copy()


def _blocks(layout: Layout) -> list[dict[str, Any]]:
    """The layout as the agent is told it."""
    return [
        {"name": block.name, "shape": block.shape, "unit": block.unit, "frame": block.frame}
        for block in layout.present
    ]
