"""Films of chosen episodes: played again alone, saved as state rows, rendered two at a time.

Scoring never needs graphics. Where no frame can be rendered, the scores stand and the message says
what to install.
"""

from __future__ import annotations

import dataclasses
import threading
import zipfile
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

from hipg_bench.errors import HipgError, RenderError
from hipg_bench.evaluation.episodes import EvaluationJob, Row
from hipg_bench.evaluation.failures import OK
from hipg_bench.paths import replacing
from hipg_bench.policies.bundle import Agent
from hipg_bench.rendering import film, gl
from hipg_bench.spec import TaskSpec

_AT_ONCE = 2
_SIZE, _FPS = (960, 540), 24
"""Of films, which take 25 to 32 s of one core each without a graphics card."""


@dataclasses.dataclass(frozen=True)
class Film:
    """One film.

    Attributes:
        spec: of which task, as it was in that world.
        agent: who plays.
        title: what is seen.
        end_reason: why the episode ended.
        saved: state rows, written.
        video: the film, to be made.
    """

    spec: TaskSpec
    agent: str
    title: str
    end_reason: str
    saved: Path
    video: Path

    @property
    def file(self) -> str:
        """The film's path inside the evaluation's folder."""
        return f"{self.video.parent.name}/{self.video.name}"


def choose_all(
    agent: Agent,
    specs: Sequence[TaskSpec],
    rows: Mapping[str, Sequence[Row]],
    job: EvaluationJob,
    count: int,
    out: Path,
) -> tuple[list[Film], list[str]]:
    """`choose` for every task.

    Returns:
        The films, and what went wrong: an agent whose episodes do not come out the same has none.
    """
    chosen: list[Film] = []
    trouble: list[str] = []
    for spec in specs:
        try:
            chosen += choose(agent, spec, rows[spec.task], job, count, out)
        except HipgError as error:
            trouble.append(str(error))
    return chosen, trouble


def choose(
    agent: Agent, spec: TaskSpec, rows: Sequence[Row], job: EvaluationJob, count: int, out: Path
) -> list[Film]:
    """Pick the median episode of the first training seed, then others from worst to best; save the states.

    Episodes in which the agent failed are not filmed.

    Raises:
        HipgError: an episode played again came out otherwise.
    """
    first_seed = min(row["train_seed"] for row in rows)
    ranked = sorted(
        (row for row in rows if row["train_seed"] == first_seed and row["status"] == OK),
        key=lambda row: (row["return"], row["world"]),
    )
    if not ranked:
        return []
    others = np.linspace(0.0, 1.0, max(count - 1, 1)).tolist()[: max(count - 1, 0)]
    chosen: list[Film] = []
    for quantile in [0.5, *others][:count]:
        row = ranked[round(quantile * (len(ranked) - 1))]
        median = not chosen
        name = spec.task if median else f"{spec.task}-q{round(100 * quantile):03d}"
        what = "the median episode" if median else f"quantile {quantile:.2f}"
        chosen.append(
            Film(
                spec=job.spec(spec, row["world"]),
                agent=agent.name,
                end_reason=row["end_reason"],
                title=f"{what}: return {row['return']:.1f}, {row['deaths']} dead",
                saved=out / "films" / f"{name}.npz",
                video=out / "videos" / f"{name}.mp4",
            )
        )
        if not _is_of(chosen[-1].saved, row):
            chosen[-1].video.unlink(missing_ok=True)
            _save(agent, spec, row, job, chosen[-1].saved)
    return chosen


def make(films: Sequence[Film], advance: Callable[[float], None]) -> list[str]:
    """Render what is not yet rendered.

    Returns:
        What went wrong with those that are still missing.
    """
    waiting = [one for one in films if not one.video.exists()]
    advance(len(films) - len(waiting))
    if waiting:
        # tried once, before the threads ask for it
        gl.working_backend()
    stop = threading.Event()
    trouble: list[str] = []
    with ThreadPoolExecutor(_AT_ONCE) as pool:
        pending = [pool.submit(_make_one, one, stop, advance) for one in waiting]
        try:
            for future in pending:
                try:
                    future.result()
                except RenderError as error:
                    trouble.append(str(error))
        finally:
            stop.set()
            pool.shutdown(wait=False, cancel_futures=True)
    return list(dict.fromkeys(trouble))


def _make_one(one: Film, stop: threading.Event, advance: Callable[[float], None]) -> None:
    """Render a film in a child process, unless told to stop."""
    told = 0.0

    def progress(frames: int, total: int) -> None:
        nonlocal told
        if stop.is_set():
            raise RenderError(f"{one.file}: interrupted")
        advance(frames / total - told)
        told = frames / total

    with np.load(one.saved, allow_pickle=False) as saved:
        rows = saved["rows"]
    film.record(
        one.spec, rows, one.video, agent=one.agent, end_reason=one.end_reason, size=_SIZE, fps=_FPS,
        progress=progress,
    )  # fmt: skip
    film.write_poster(one.video, one.video.with_suffix(".jpg"))


def _is_of(saved: Path, row: Row) -> bool:
    """Whether an episode is already saved whole, and not another one of a shorter evaluation."""
    if not saved.exists():
        return False
    try:
        with np.load(saved, allow_pickle=False) as file:
            return (int(file["train_seed"]), int(file["world"])) == (row["train_seed"], row["world"])
    except (OSError, EOFError, ValueError, KeyError, TypeError, zipfile.BadZipFile):
        return False  # damaged; it is written again


def _save(agent: Agent, spec: TaskSpec, row: Row, job: EvaluationJob, path: Path) -> None:
    """Keep an episode's state rows, and what is needed to read them."""
    rows = job.record(spec, agent.policy(spec, row["train_seed"]), row)
    with replacing(path) as temporary:
        np.savez_compressed(
            temporary, rows=rows, spec=job.spec(spec, row["world"]).model_dump_json(), agent=agent.name,
            train_seed=row["train_seed"], world=row["world"],
        )  # fmt: skip
