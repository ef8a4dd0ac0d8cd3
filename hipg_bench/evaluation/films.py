"""Films of chosen episodes: played again alone, saved as state rows, rendered by two child processes.

Scoring never needs graphics. Where no frame can be rendered, the scores stand and the message says
what to install.
"""

from __future__ import annotations

import dataclasses
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import IO

import numpy as np

from hipg_bench.errors import HipgError
from hipg_bench.evaluation.episodes import Plan, Row
from hipg_bench.paths import replacing
from hipg_bench.policies.bundle import Agent
from hipg_bench.spec import TaskSpec, parse

_CHILDREN = 2


@dataclasses.dataclass(frozen=True)
class Job:
    """One film.

    Attributes:
        task: of which task.
        title: what is seen.
        saved: state rows, written.
        video: the film, to be made.
    """

    task: str
    title: str
    saved: Path
    video: Path

    @property
    def file(self) -> str:
        """The film's path inside the evaluation's folder."""
        return f"{self.video.parent.name}/{self.video.name}"


def choose(agent: Agent, spec: TaskSpec, rows: Sequence[Row], plan: Plan, count: int, out: Path) -> list[Job]:
    """Pick the median episode of the first training seed, then others from worst to best; save the states."""
    first_seed = min(row["train_seed"] for row in rows)
    ranked = sorted(
        (row for row in rows if row["train_seed"] == first_seed),
        key=lambda row: (row["return"], row["world"]),
    )
    others = np.linspace(0.0, 1.0, max(count - 1, 1)).tolist()[: max(count - 1, 0)]
    jobs: list[Job] = []
    for quantile in [0.5, *others][:count]:
        row = ranked[round(quantile * (len(ranked) - 1))]
        median = not jobs
        name = spec.task if median else f"{spec.task}-q{round(100 * quantile):03d}"
        what = "the median episode" if median else f"quantile {quantile:.2f}"
        jobs.append(
            Job(
                task=spec.task,
                title=f"{what}: return {row['return']:.1f}, {row['deaths']} dead",
                saved=out / "films" / f"{name}.npz",
                video=out / "videos" / f"{name}.mp4",
            )
        )
        if not jobs[-1].saved.exists():
            _save(agent, spec, row, plan, jobs[-1].saved)
    return jobs


def make(jobs: Sequence[Job], advance: Callable[[float], None]) -> tuple[list[Job], list[str]]:
    """Render what is not yet rendered; return the films there are, and what went wrong with the others."""
    made = {job for job in jobs if job.video.exists()}
    advance(len(made))
    waiting = [job for job in jobs if job not in made]
    running: list[tuple[Job, subprocess.Popen[bytes], IO[bytes]]] = []
    trouble: list[str] = []
    try:
        while waiting or running:
            while waiting and len(running) < _CHILDREN:
                running.append(_start(waiting.pop(0)))
            time.sleep(0.05)
            for entry in [entry for entry in running if entry[1].poll() is not None]:
                job, child, said = entry
                running.remove(entry)
                if child.returncode == 0:
                    made.add(job)
                else:
                    said.seek(0)
                    trouble.append(said.read().decode(errors="replace").strip() or f"{job.file}: no film")
                advance(1)
    finally:
        for _, child, _ in running:
            child.terminate()
            child.wait()
    return [job for job in jobs if job in made], list(dict.fromkeys(trouble))


def _save(agent: Agent, spec: TaskSpec, row: Row, plan: Plan, path: Path) -> None:
    rows = plan.record(spec, agent.policy(spec, row["train_seed"]), row)
    with replacing(path) as temporary:
        np.savez_compressed(temporary, rows=rows, spec=spec.model_dump_json(), agent=agent.name)


def _start(job: Job) -> tuple[Job, subprocess.Popen[bytes], IO[bytes]]:
    """Render in a process of its own: a graphics driver may take its process down with it."""
    job.video.parent.mkdir(parents=True, exist_ok=True)
    said = tempfile.TemporaryFile()  # noqa: SIM115 (lives as long as the child)
    command = [sys.executable, "-m", __name__, str(job.saved), str(job.video)]
    return job, subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=said), said


def _render(saved: Path, video: Path) -> None:
    """Turn saved state rows into a film, here."""
    from hipg_bench.rendering import film

    with np.load(saved, allow_pickle=False) as file:
        spec = parse(TaskSpec, json.loads(str(file["spec"])), str(saved))
        film.record(spec, file["rows"], video, agent=str(file["agent"]))


if __name__ == "__main__":
    try:
        _render(Path(sys.argv[1]), Path(sys.argv[2]))
    except HipgError as error:
        sys.exit(str(error))
