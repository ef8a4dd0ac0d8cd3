"""Step rates: the environment beside raw `mujoco.batch` on the same model, in the same states."""

from __future__ import annotations

import dataclasses
import time

import mujoco
import numpy as np
from mujoco.batch import Batch

from hipg_bench import registry
from hipg_bench.spec import TaskSpec

_POOL = 16
"""Actions drawn beforehand, so that drawing is not timed."""


@dataclasses.dataclass(frozen=True)
class Rate:
    """Speed of a task.

    Attributes:
        task, num_envs, threads: what was run; threads 0 is all cores.
        env: control steps per second, summed over the worlds.
        raw: the same of the physics alone.
        share: env / raw, the median over pairs of neighbouring chunks.
    """

    task: str
    num_envs: int
    threads: int
    env: float
    raw: float
    share: float


def measure(spec: TaskSpec, num_envs: int, *, threads: int = 0, seconds: float = 2.0) -> Rate:
    """Time environment and physics in turn, in short chunks, so that both meet the same machine.

    Raw physics starts each chunk in the environment's states, and gets random controls.

    Args:
        spec: the task.
        num_envs: B.
        threads: physics threads.
        seconds: for both together.
    """
    env = registry.make(spec, num_envs, threads=threads)
    env.reset()
    raw = Batch(env.model, num_envs, threads)
    chance = np.random.default_rng(0)
    actions = chance.uniform(-1, 1, (_POOL, num_envs, env.num_agents, env.action_size))
    controls = chance.uniform(-1, 1, (_POOL, num_envs, env.model.nu))
    control, stage = raw.bind("ctrl"), int(mujoco.mjtStage.mjSTAGE_NONE)

    def run_env(steps: int) -> float:
        started = time.perf_counter()
        for k in range(steps):
            env.step(actions[k % _POOL])
        return time.perf_counter() - started

    def run_raw(steps: int) -> float:
        raw.state[:] = env.rows
        started = time.perf_counter()
        for k in range(steps):
            control[:] = controls[k % _POOL]
            raw.step(nstep=env.decimation, stage=stage)
        return time.perf_counter() - started

    run_env(2)
    run_raw(2)
    chunk = max(1, round(0.05 / (run_env(4) / 4)))
    times: list[tuple[float, float]] = []
    until = time.perf_counter() + seconds
    while time.perf_counter() < until or len(times) < 3:
        times.append((run_env(chunk), run_raw(chunk)))
    env_time, raw_time = np.array(times).T
    steps = num_envs * chunk
    return Rate(
        spec.task, num_envs, threads,
        env=float(np.median(steps / env_time)),
        raw=float(np.median(steps / raw_time)),
        share=float(np.median(raw_time / env_time)),
    )  # fmt: skip
