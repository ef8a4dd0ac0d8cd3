"""A training run in a folder: what it leaves behind, and how it goes on after a kill."""

from __future__ import annotations

import csv
import io
import json
import platform
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mujoco
import torch
from torch.utils.tensorboard import SummaryWriter

from hipg_bench.learning.mappo import Trainer
from hipg_bench.learning.settings import Settings
from hipg_bench.paths import write_text
from hipg_bench.policies.network import save_network
from hipg_bench.registry import task_spec

_SAVE_EVERY = 10
"""Iterations between checkpoints; a kill loses fewer."""

Log = dict[str, float]


def train(
    settings: Settings, out: Path, *, command: str, report: Callable[[int, Log], None] | None = None
) -> None:
    """Train in a new folder, or go on where an earlier run with the same settings stopped.

    The folder gets ``checkpoint.pt`` (all that is needed to go on), ``policy.safetensors`` and
    ``curve.csv`` and ``train.json`` (what an agent bundle needs), and TensorBoard events.

    Args:
        settings: the run; ``steps`` may be larger than before.
        out: the folder.
        command: the command line, for the record.
        report: called after every iteration with its number and what was logged.

    Raises:
        ResumeError: the folder holds a run with other settings.
    """
    out.mkdir(parents=True, exist_ok=True)
    trainer = Trainer(settings)
    checkpoint, curve = out / "checkpoint.pt", out / "curve.csv"
    rows: list[dict[str, Any]] = []
    if checkpoint.exists():
        trainer.resume(checkpoint)
        rows = list(csv.DictReader(io.StringIO(curve.read_text())))[: trainer.iteration]
    before = float(rows[-1]["seconds"]) if rows else 0.0
    started = time.monotonic()
    with SummaryWriter(str(out / "tensorboard"), purge_step=trainer.iteration) as board:
        while trainer.iteration < settings.iterations:
            log = trainer.iterate()
            seconds = round(before + time.monotonic() - started, 1)
            steps = trainer.iteration * settings.num_envs * settings.rollout
            rows.append({"iteration": trainer.iteration, "steps": steps, "seconds": seconds, **log})
            for name, value in log.items():
                board.add_scalar(name, value, trainer.iteration)
            if report is not None:
                report(trainer.iteration, log)
            if trainer.iteration % _SAVE_EVERY == 0 or trainer.iteration >= settings.iterations:
                # the checkpoint goes last: what it says was done is then on disk
                save_network(trainer.actor.tensors(), out / "policy.safetensors")
                write_text(curve, _table(rows))
                write_text(out / "train.json", _record(trainer, command, steps, seconds))
                trainer.save(checkpoint)


def _table(rows: list[dict[str, Any]]) -> str:
    """Rows as CSV; a value that an iteration did not have is left empty."""
    names = list(dict.fromkeys(name for row in rows for name in row))
    text = io.StringIO()
    writer = csv.DictWriter(text, names, lineterminator="\n")
    writer.writeheader()
    for row in rows:
        writer.writerow(
            {name: f"{value:.6g}" if isinstance(value, float) else value for name, value in row.items()}
        )
    return text.getvalue()


def _record(trainer: Trainer, command: str, steps: int, seconds: float) -> str:
    """Everything a model card needs to know about where the weights came from."""
    spec = task_spec(trainer.settings.task)  # as it is scored, without the weights of training
    content = {
        "command": command,
        "task": spec.task,
        "task_version": spec.version,
        "task_fingerprint": spec.fingerprint,
        "settings": trainer.settings.model_dump(),
        "env_steps": steps,
        "agent_steps": steps * spec.num_agents,
        "seconds": seconds,
        "threads": torch.get_num_threads(),
        "machine": platform.processor() or platform.machine(),
        "versions": {
            "mujoco": mujoco.__version__,
            "torch": torch.__version__,
            "python": platform.python_version(),
        },
    }
    return json.dumps(content, indent=2) + "\n"
