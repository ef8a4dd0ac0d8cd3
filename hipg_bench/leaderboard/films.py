"""Films for the page: small, and all agents in the same world, so that they can be seen side by side."""

from __future__ import annotations

import subprocess
import tempfile
from collections.abc import Sequence
from pathlib import Path

import imageio_ffmpeg

from hipg_bench.errors import HipgError, RenderError
from hipg_bench.evaluation.episodes import EvaluationJob, Row
from hipg_bench.leaderboard.playing import BoardEvaluation, Progress
from hipg_bench.leaderboard.rows import parse_rows
from hipg_bench.paths import replacing
from hipg_bench.policies.bundle import Agent
from hipg_bench.registry import task_spec
from hipg_bench.rendering import film

WORLD = 2
"""The public world that everybody is filmed in: fixed beforehand, so nobody's best episode is chosen."""
_SIZE, _FPS = (640, 360), 15
_SMALL = (
    "-c:v",
    "libx264",
    "-crf",
    "31",
    "-preset",
    "slow",
    "-pix_fmt",
    "yuv420p",
    "-movflags",
    "+faststart",
)


def make(
    agent: Agent,
    evaluation: BoardEvaluation,
    tasks: Sequence[str],
    work: Path,
    folder: Path,
    progress: Progress,
) -> list[str]:
    """Film an agent in tasks that it plays and has no film of; return what went wrong."""
    job = evaluation.job("standard")
    trouble: list[str] = []
    for task in tasks:
        rows = work / "standard" / "episodes" / f"{task}.jsonl"
        row = _row(rows) if rows.is_file() else None
        if row is not None and not (folder / "films" / f"{task}.mp4").exists():
            try:
                _film(agent, task, row, job, folder / "films" / f"{task}.mp4")
            except HipgError as error:
                trouble.append(f"{task}: {error}")
        progress("films", 1.0, len(tasks))
    return trouble


def _row(path: Path) -> Row | None:
    """The row of the filmed world, of the first training seed; None if the agent failed there."""
    rows = parse_rows(path.read_bytes(), str(path))
    return next((row for row in rows if row["world"] == WORLD and row["status"] == "ok"), None)


def _film(agent: Agent, task: str, row: Row, job: EvaluationJob, out: Path) -> None:
    """Play the world again and film it.

    Raises:
        HipgError: it came out otherwise, or no frame can be rendered.
    """
    spec = task_spec(task)
    states = job.record(spec, agent.policy(spec, row["train_seed"]), row)
    with tempfile.TemporaryDirectory(prefix="hipg-film-") as place:
        large = Path(place) / out.name
        film.record(spec, states, large, agent=agent.name, size=_SIZE, fps=_FPS, end_reason=row["end_reason"])
        with replacing(out) as small:
            _shrink(large, small)


def _shrink(large: Path, small: Path) -> None:
    """Encode a film again, for a page.

    Raises:
        RenderError: the encoder failed.
    """
    exact = ("-fflags", "+bitexact", "-flags:v", "+bitexact", "-map_metadata", "-1", "-threads", "1")
    command = [
        imageio_ffmpeg.get_ffmpeg_exe(),
        "-v",
        "error",
        "-y",
        "-i",
        str(large),
        *_SMALL,
        *exact,
        str(small),
    ]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise RenderError(f"{small.name}: {done.stderr.strip()}")
