"""Some episodes as the board would play them: same evaluation, same sandbox, same clocks."""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from hipg_bench.errors import AgentFailure, BundleError, HostFailure
from hipg_bench.evaluation.decentralised import verify
from hipg_bench.evaluation.episodes import EvaluationJob, Row
from hipg_bench.evaluation.failures import OK, close
from hipg_bench.policies.bundle import Agent
from hipg_bench.policies.policy import Policy
from hipg_bench.sandbox.budget import PROTOCOL
from hipg_bench.spec import TaskSpec
from hipg_bench.submissions.findings import Finding, advice, error, fine

_JOB = EvaluationJob(threads=1)
"""Public worlds, in which nobody is scored for the board."""
_WORLDS = [0, 1, 2, 3]
_LITTLE = 0.05
_REMEDIES = {
    "crash": "in its process it sees this environment's packages and its own folder, read-only; no other "
    "file, no network, no program",
    "timeout": f"a step may take {1000 * PROTOCOL.soft:.0f} ms on one thread: use a smaller network, or set "
    f"up what takes long in make_agent ({PROTOCOL.start_up:.0f} s)",
    "not_finite": "look for divisions by a deviation of 0, and for observations of the dead, which are 0",
    "wrong_shape": "act must return an array of numbers (B, N, A) for observations (B, N, O)",
}
"""By the status of a failed episode."""
_OFTEN = {
    "ModuleNotFoundError": "it can import this environment's packages and the .py files of its own folder",
    "has no attribute 'make": 'entry_point = "my_agent:make_agent" is the function make_agent in my_agent.py',
    "FileNotFoundError": "is the file in the folder? read it from Path(__file__).parent, wherever that is",
    "not finite": "the training diverged: export what it had before",
    "train again": "it was trained on another task or version of it: is it in the right folder?",
    "formats 'hipg": "write the file with hipg_bench.policies.export (or save_network)",
}
"""By what the message holds."""


class Heard:
    """A policy that is listened to: why it failed, and how long it took.

    Attributes:
        privileged: the policy's.
        failure: the first.
        start_up: longest start of an episode, s.
        laps: time per step of worlds played alone, s.
    """

    def __init__(self, policy: Policy) -> None:
        self.privileged = policy.privileged
        self.failure: AgentFailure | None = None
        self.start_up = 0.0
        self.laps: list[float] = []
        self._policy = policy

    def initial_state(self, seed: int, episode_id: Int[np.ndarray, "B"], num_agents: int) -> Any:
        """The policy's memory."""
        started = time.perf_counter()
        try:
            return self._policy.initial_state(seed, episode_id, num_agents)
        except AgentFailure as failure:
            self.failure = self.failure or failure
            raise
        finally:
            self.start_up = max(self.start_up, time.perf_counter() - started)

    def act(
        self, seen: np.ndarray, memory: Any, alive: Bool[np.ndarray, "B N"]
    ) -> tuple[Float[np.ndarray, "B N A"], Any]:
        """The policy's actions."""
        started = time.perf_counter()
        try:
            answer = self._policy.act(seen, memory, alive)
        except AgentFailure as failure:
            self.failure = self.failure or failure
            raise
        if len(alive) == 1:
            self.laps.append(time.perf_counter() - started)
        return answer

    def close(self) -> None:
        """Let go of what the policy holds."""
        close(self._policy)


def try_task(agent: Agent, spec: TaskSpec, train_seed: int) -> Iterator[Finding]:
    """Play a world alone, and again among others."""
    where = f"{spec.task}, seed {train_seed}"
    try:
        heard = Heard(agent.policy(spec, train_seed))
        (alone,) = _JOB.play(spec, heard, _WORLDS[:1])
        together = _JOB.play(spec, heard, _WORLDS) if alone["status"] == OK else []
    except BundleError as trouble:
        yield error(where, str(trouble), _first_that_fits(str(trouble)) or _reminder(agent, spec))
        return
    except HostFailure as trouble:
        yield error(where, str(trouble), "the fault is this machine's: `hipg-bench doctor` looks at it")
        return
    failed = next((row for row in (alone, *together) if row["status"] != OK), None)
    if failed is not None:
        said = f": {heard.failure}" if heard.failure else ""
        remedy = _first_that_fits(said) or _REMEDIES[failed["status"]]
        yield error(where, f"the agent failed ({failed['status']}){said}", remedy)
        return
    yield from _compare(where, together, alone)
    yield from _judge_time(where, heard)


def try_weights(agent: Agent, spec: TaskSpec, train_seed: int) -> Iterator[Finding]:
    """Load a policy without playing it."""
    try:
        close(agent.policy(spec, train_seed))
    except BundleError as trouble:
        remedy = _first_that_fits(str(trouble)) or _reminder(agent, spec)
        yield error(f"{spec.task}, seed {train_seed}", str(trouble), remedy)


def try_alone(agent: Agent, spec: TaskSpec, train_seed: int) -> Iterator[Finding]:
    """Whether agents act on their own observations alone, as the card says."""
    verdict = verify(spec, agent.policy(spec, train_seed), _JOB, _WORLDS)
    if verdict.decentralised:
        yield fine(spec.task, str(verdict))
    else:
        yield advice(
            spec.task, f"{verdict}; the card says {agent.card.execution!r}",
            'use an agent\'s own observation and memory only, or say execution = "centralised" in agent.toml',
        )  # fmt: skip


def _compare(where: str, together: list[Row], alone: Row) -> Iterator[Finding]:
    """What was reached, and whether it was the same both times."""
    if together[0] != alone:
        yield error(
            where, f"world 0 returned {together[0]['return']:.6g} among {len(together)} worlds and "
            f"{alone['return']:.6g} alone: its actions depend on chance or on the other worlds",
            "take the best action, or draw from a generator per world, seeded in reset(seeds)",
        )  # fmt: skip
    scores = [row["score"] for row in together if row["score"] is not None]
    if not scores:
        return
    score = float(np.mean(scores))
    if score < _LITTLE:
        yield advice(
            where, f"mean score of {len(scores)} worlds: {score:.2f}; 0 is random, 1 the reference",
            "if it did better in training: is its observation normaliser in the file? what scales actions?",
        )  # fmt: skip
    else:
        yield fine(where, f"mean score of {len(scores)} worlds: {score:.2f}")


def _judge_time(where: str, heard: Heard) -> Iterator[Finding]:
    """Time per step against the budget."""
    median, worst = 1000 * float(np.median(heard.laps)), 1000 * max(heard.laps)
    text = f"a step takes {median:.1f} ms, at most {worst:.1f} ms, of {1000 * PROTOCOL.soft:.0f} ms"
    if median > 1000 * PROTOCOL.soft:
        yield error(where, text, _REMEDIES["timeout"])
    elif median > 500 * PROTOCOL.soft or heard.start_up > PROTOCOL.start_up / 2:
        started = f"; it takes {heard.start_up:.0f} s to start, of {PROTOCOL.start_up:.0f} s"
        yield advice(where, text + started, "the board's machine may be slower: " + _REMEDIES["timeout"])
    else:
        yield fine(where, text)


def _first_that_fits(said: str) -> str:
    """What to do about a mistake that is often made; empty if it is another."""
    return next((remedy for words, remedy in _OFTEN.items() if words in said), "")


def _reminder(agent: Agent, spec: TaskSpec) -> str:
    """How such weights are made."""
    if agent.card.kind == "network":
        return f"hipg_bench.policies.export writes such files; `hipg-bench tasks show {spec.task}` has (O, A)"
    if agent.card.kind == "onnx":
        return "docs/guides/submit.md shows torch.onnx.export with the names and shapes that are needed"
    return "docs/guides/submit.md says what agent.toml must say"
