"""Steps and resets: the environment beside raw `mujoco.batch` on the same model, in the same states."""

from __future__ import annotations

import dataclasses
import itertools
import time

import mujoco
import numpy as np
from mujoco.batch import Batch

from hipg_bench import registry
from hipg_bench.env import BatchEnv
from hipg_bench.evaluation.bench.child import peak_memory
from hipg_bench.evaluation.bench.timing import Contender, in_turn
from hipg_bench.spec import TaskSpec

_POOL = 16
"""Actions drawn beforehand, so that drawing is not timed."""


@dataclasses.dataclass(frozen=True)
class Rate:
    """Speed of a task.

    Attributes:
        task, num_envs, threads: what was run.
        env_steps: control steps per second, summed over the worlds.
        agent_steps: the same times the number of agents.
        raw_steps: control steps per second of the physics alone, the ceiling.
        share: of the ceiling, the median over pairs of neighbouring chunks.
        peak_mb: most memory of the process, before the ceiling's own worlds were made.
    """

    task: str
    num_envs: int
    threads: int
    env_steps: float
    agent_steps: float
    raw_steps: float
    share: float
    peak_mb: float


def step_rate(spec: TaskSpec, num_envs: int, threads: int, seconds: float) -> list[Rate]:
    """Time environment and physics in turn; the worlds' episodes end one after another, not all at once.

    Raw physics starts each chunk in the environment's states, and gets random controls.

    Args:
        spec: the task.
        num_envs: B.
        threads: physics threads, 0 for all cores.
        seconds: for both together.
    """
    env, step = stepping(spec, num_envs, threads)
    for _ in range(3):
        step.call()
    memory = peak_memory()
    times = in_turn({"env": step, "raw": _physics(env, threads)}, seconds)
    rate = num_envs / times.median("env")
    return [
        Rate(
            spec.task, num_envs, threads,
            env_steps=rate,
            agent_steps=rate * env.num_agents,
            raw_steps=num_envs / times.median("raw"),
            share=times.ratio("raw", "env"),
            peak_mb=memory,
        )
    ]  # fmt: skip


def stepping(spec: TaskSpec, num_envs: int, threads: int) -> tuple[BatchEnv, Contender]:
    """Worlds in the midst of their episodes, and random steps of them."""
    env = registry.make(spec, num_envs, threads=threads)
    env.reset()
    rows = env.rows
    # endings and their resets are then spread over the horizon, as they are in a long run
    rows = env.set_field(rows, "elapsed", np.arange(num_envs) * spec.horizon // num_envs)
    env.load_rows(np.arange(num_envs), rows)
    chance = np.random.default_rng(0)
    actions = itertools.cycle(chance.uniform(-1, 1, (_POOL, num_envs, env.num_agents, env.action_size)))
    return env, Contender(lambda: env.step(next(actions)))


def _physics(env: BatchEnv, threads: int) -> Contender:
    """The same worlds, stepped by the engine alone."""
    raw = Batch(env.model, env.num_envs, threads)
    controls = itertools.cycle(np.random.default_rng(0).uniform(-1, 1, (_POOL, env.num_envs, env.model.nu)))
    control, stage = raw.bind("ctrl"), int(mujoco.mjtStage.mjSTAGE_NONE)

    def call() -> None:
        control[:] = next(controls)
        raw.step(nstep=env.decimation, stage=stage)

    def prepare() -> None:
        raw.state[:] = env.rows

    return Contender(call, prepare)


@dataclasses.dataclass(frozen=True)
class Reset:
    """What it costs to begin.

    Attributes:
        task, num_envs, threads: what was run.
        make_ms: to build the worlds, compiling the model included, once.
        reset_ms: to reset all of them.
        per_world_us: the same per world.
        in_steps: resetting all, in control steps of all.
        peak_mb: most memory of the process.
    """

    task: str
    num_envs: int
    threads: int
    make_ms: float
    reset_ms: float
    per_world_us: float
    in_steps: float
    peak_mb: float | None = None


def reset_time(spec: TaskSpec, num_envs: int, threads: int, seconds: float) -> list[Reset]:
    """Time resets of all worlds beside their steps; arguments as of `step_rate`."""
    started = time.perf_counter()
    registry.make(spec, num_envs, threads=threads)
    made = time.perf_counter() - started
    env, step = stepping(spec, num_envs, threads)
    times = in_turn({"reset": Contender(env.reset), "step": step}, seconds)
    taken = times.median("reset")
    return [
        Reset(
            spec.task, num_envs, threads,
            make_ms=1e3 * made,
            reset_ms=1e3 * taken,
            per_world_us=1e6 * taken / num_envs,
            in_steps=times.ratio("reset", "step"),
        )
    ]  # fmt: skip
