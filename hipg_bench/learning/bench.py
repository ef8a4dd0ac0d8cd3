"""Where the time of a training iteration goes."""

from __future__ import annotations

import dataclasses
import time
from typing import Any

import numpy as np
import torch

from hipg_bench.errors import SpecError
from hipg_bench.learning import torch_setup
from hipg_bench.learning.mappo import Trainer
from hipg_bench.learning.settings import Settings, recommended


@dataclasses.dataclass(frozen=True)
class Iteration:
    """Medians over iterations.

    Attributes:
        task, algorithm, num_envs, rollout, epochs, minibatches, threads: what was run.
        seconds: of a whole iteration.
        rollout_share, credit_share, update_share: of it.
        agent_steps: learned from per second, N of them per control step of a world.
        peak_mb: most memory of the process, None where nobody looked.
    """

    task: str
    algorithm: str
    num_envs: int
    rollout: int
    epochs: int
    minibatches: int
    threads: int
    seconds: float
    rollout_share: float
    credit_share: float
    update_share: float
    agent_steps: float
    peak_mb: float | None = None


def iteration_time(
    task: str, threads: int, seconds: float, changes: dict[str, Any] | None = None
) -> list[Iteration]:
    """Time training iterations with the recommended settings.

    Args:
        task: its name.
        threads: of physics and of torch.
        seconds: for all; two iterations are run at least, after one that does not count.
        changes: settings that differ from the recommended.

    Raises:
        UnknownNameError: no such task.
        SpecError: a setting that is not allowed.
    """
    settings = recommended(task, **changes or {})
    if not isinstance(settings, Settings):
        raise SpecError(f"{task}: the algorithms of MAPPO are timed, got {settings.algorithm!r}")
    torch.set_num_threads(threads)
    torch_setup.configure()
    trainer = Trainer(settings)
    _iterate(trainer)
    parts: list[tuple[float, float, float]] = []
    until = time.perf_counter() + seconds
    while time.perf_counter() < until or len(parts) < 2:
        parts.append(_iterate(trainer))
    whole = np.sum(parts, axis=1)
    rollout, credit, update = np.median(np.array(parts) / whole[:, None], axis=0).tolist()
    taken = float(np.median(whole))
    return [
        Iteration(
            task, settings.algorithm, settings.num_envs, settings.rollout, settings.epochs,
            settings.minibatches, threads,
            seconds=taken,
            rollout_share=rollout,
            credit_share=credit,
            update_share=update,
            agent_steps=settings.num_envs * settings.rollout * trainer.env.num_agents / taken,
        )
    ]  # fmt: skip


def _iterate(trainer: Trainer) -> tuple[float, float, float]:
    """Seconds of the parts of `Trainer.iterate`."""
    times = [time.perf_counter()]
    data = trainer.roll_out()
    times.append(time.perf_counter())
    target, psi = trainer.assign_credit(data)
    times.append(time.perf_counter())
    trainer.update(data, target, psi)
    times.append(time.perf_counter())
    rollout, credit, update = np.diff(times).tolist()
    return rollout, credit, update
