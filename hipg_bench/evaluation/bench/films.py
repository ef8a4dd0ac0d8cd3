"""Films beside a bare `mujoco.Renderer` loop of the same world, size and encoder, without what films add."""

from __future__ import annotations

import contextlib
import dataclasses
import resource
import tempfile
import time
from pathlib import Path
from typing import Any

import imageio_ffmpeg
import mujoco
import numpy as np
from jaxtyping import Float

from hipg_bench import registry
from hipg_bench.rendering import film
from hipg_bench.rendering.motion import Trajectory
from hipg_bench.rendering.scene import Scene
from hipg_bench.spec import TaskSpec

_FPS = 30


@dataclasses.dataclass(frozen=True)
class FilmTime:
    """What a frame costs, encoding included.

    Attributes:
        task, width, height, backend: what was filmed, in pixels, by which OpenGL.
        film_ms: per frame of a film.
        bare_ms: per frame of the bare loop.
        over_bare: film / bare - 1, the median over pairs.
        start_s: from the call to the first frame.
        peak_mb: most memory of the process that films.
    """

    task: str
    width: int
    height: int
    backend: str
    film_ms: float
    bare_ms: float
    over_bare: float
    start_s: float
    peak_mb: float


def film_time(
    spec: TaskSpec, size: tuple[int, int], backend: str, frames: int, rounds: int
) -> list[FilmTime]:
    """Make short films and bare ones in turn; runs in a process that has the backend's environment.

    Args:
        spec: the task.
        size: width and height, pixels.
        backend: OpenGL to use.
        frames: of each film, without the end card.
        rounds: films of each kind.
    """
    rows = _rows(spec, 1 + round(frames / _FPS * film.pace_of(spec) / spec.control_step))
    with tempfile.TemporaryDirectory(prefix="hipg-bench-") as folder:
        out = Path(folder) / "film.mp4"
        pairs = [
            (_film(spec, rows, out, size, backend), _bare(spec, rows, out, size, frames))
            for _ in range(rounds)
        ]
    ours = np.array([one.per_frame for one, _ in pairs])
    bare = np.array([one.per_frame for _, one in pairs])
    # this process has waited for the films' processes and for encoders, which are smaller
    peak = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss * 1024 / 1e6
    return [
        FilmTime(
            spec.task, *size, backend,
            film_ms=1e3 * float(np.median(ours)),
            bare_ms=1e3 * float(np.median(bare)),
            over_bare=float(np.median(ours / bare)) - 1,
            start_s=float(np.median([one.until_first for one, _ in pairs])),
            peak_mb=peak,
        )
    ]  # fmt: skip


class _Shutter:
    """Notes when frames are done."""

    def __init__(self) -> None:
        self._started = time.perf_counter()
        self._at: list[float] = []

    def click(self) -> None:
        self._at.append(time.perf_counter())

    @property
    def until_first(self) -> float:
        return self._at[0] - self._started

    @property
    def per_frame(self) -> float:
        """The first one opens the context and compiles shaders; it does not count."""
        return (self._at[-1] - self._at[0]) / (len(self._at) - 1)


def _rows(spec: TaskSpec, count: int) -> Float[np.ndarray, "K R"]:
    """State rows of a world under random actions."""
    env = registry.make(spec, 1, threads=1)
    env.reset()
    chance = np.random.default_rng(0)
    rows = [env.rows]
    for _ in range(count - 1):
        env.step(chance.uniform(-1, 1, (1, env.num_agents, env.action_size)))
        rows.append(env.rows)
    return np.concatenate(rows)


def _film(
    spec: TaskSpec, rows: Float[np.ndarray, "K R"], out: Path, size: tuple[int, int], backend: str
) -> _Shutter:
    """As `hipg-bench video` does it."""
    shutter = _Shutter()
    seconds = (len(rows) - 1) * spec.control_step
    moving = round(seconds / film.pace_of(spec) * _FPS)

    def progress(done: int, _total: int) -> None:
        # the end card is not drawn by OpenGL
        if done <= moving:
            shutter.click()

    film.record(spec, rows, out, agent="random", size=size, fps=_FPS, backend=backend, progress=progress)
    return shutter


def _bare(
    spec: TaskSpec, rows: Float[np.ndarray, "K R"], out: Path, size: tuple[int, int], frames: int
) -> _Shutter:
    """MuJoCo's renderer and the encoder, with the film's light, moments and views (worked out before)."""
    trajectory = Trajectory(spec, rows)
    scene, model = Scene(trajectory), trajectory.model
    times = np.linspace(trajectory.time[0], trajectory.time[-1], frames).tolist()
    poses: list[tuple[np.ndarray, np.ndarray, mujoco.MjvCamera]] = []
    for moment in times:
        trajectory.show(moment)
        poses.append(
            (trajectory.data.qpos.copy(), trajectory.data.mocap_pos.copy(), scene.camera(moment).mujoco())
        )
    data = mujoco.MjData(model)
    shutter = _Shutter()
    encoder = _encoder(out, size)
    encoder.send(None)
    with contextlib.closing(encoder), mujoco.Renderer(model, size[1], size[0]) as renderer:
        for qpos, mocap_pos, camera in poses:
            data.qpos[:], data.mocap_pos[:] = qpos, mocap_pos
            mujoco.mj_forward(model, data)
            renderer.update_scene(data, camera)
            encoder.send(renderer.render())
            shutter.click()
    return shutter


def _encoder(out: Path, size: tuple[int, int]) -> Any:
    """As films have it."""
    return imageio_ffmpeg.write_frames(
        str(out), size, fps=_FPS, codec="libx264",
        quality=None,  # pyright: ignore[reportArgumentType] (its default is 5; None leaves it to -crf)
        macro_block_size=2, pix_fmt_out="yuv420p", ffmpeg_log_level="error",
        output_params=["-crf", "20", "-preset", "veryfast", "-threads", "1"],
    )  # fmt: skip
