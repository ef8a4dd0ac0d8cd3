"""Films of episodes, made from saved state rows in a child process.

The child is this module, ``python -m hipg_bench.rendering.film``: it alone needs OpenGL. Frames go
to the encoder one by one, so a film of any length needs the memory of one frame. The same rows give
the same frames.
"""

from __future__ import annotations

import contextlib
import io
import os
import select
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Float

from hipg_bench import processes
from hipg_bench.errors import HipgError, RenderError
from hipg_bench.paths import PARTIAL, replacing
from hipg_bench.registry import task_spec
from hipg_bench.rendering import gl
from hipg_bench.spec import Params, TaskSpec

_WIDEST, _FASTEST = 7680, 240
FORMATS = (".mp4", ".gif")
"""By the ending of a film's name: H.264, or an animated picture."""
DEFAULTS: Mapping[str, tuple[tuple[int, int], int]] = {".mp4": ((1280, 720), 30), ".gif": ((480, 270), 12)}
"""Width and height, and frames per second, by format; GIFs of an episode then have 3 to 4 MB."""
_MOST_GIF_BYTES = 400_000_000
"""Of a GIF's frames that are kept in memory to find one palette for all, which halves the file."""

_SHORT = 6.0
"""Episodes up to this long, s, are shown at half speed: drones are quick."""
_CARD = 1.6
"""Seconds for which the end card stands."""
_FADE_IN = 0.4
"""Seconds in which it appears."""
_STALL = 120.0
"""Seconds without a frame after which the child counts as hung."""
_ENDS = {
    "horizon": "time is up",
    "physics": "the physics diverged",
    "dropped": "the plank was dropped",
    "all_fallen": "everyone has fallen",
}
"""End reasons in plain words; others are shown as they are."""

T = TypeVar("T")

Progress = Callable[[int, int], None]
"""Told how many frames of how many are done."""


class Job(Params):
    """What the child must know beside the rows.

    Attributes:
        spec: the task.
        agent: who plays.
        out: film to write.
        width, height: pixels.
        fps: frames per second.
        end_reason: why the episode ended, empty if not known.
    """

    spec: TaskSpec
    agent: str
    out: str
    width: int
    height: int
    fps: int
    end_reason: str


def record(
    task: str | TaskSpec,
    rows: Float[np.ndarray, "K R"],
    out: Path,
    *,
    agent: str,
    size: tuple[int, int] | None = None,
    fps: int | None = None,
    end_reason: str = "",
    backend: str | None = None,
    progress: Progress | None = None,
) -> None:
    """Film one episode; ``out`` appears only when the film is whole.

    Safe to call from several threads at once: the work is done in child processes.

    Args:
        task: a name, or the spec that was played.
        rows: state rows of one world, the first of the episode up to its last.
        out: file to write, its ending one of `FORMATS`.
        agent: who plays, for the caption.
        size: width and height, even numbers of pixels; by default as `DEFAULTS` says for the format.
        fps: frames per second; the same.
        end_reason: why the episode ended; the horizon is recognised without it.
        backend: OpenGL to use, by default the first that works.
        progress: told how far the film is.

    Raises:
        RenderError: a format or size that is not allowed, no working OpenGL, or a child that failed.
        UnknownNameError: no such task.
    """
    spec = task_spec(task) if isinstance(task, str) else task
    out = Path(out)
    if out.suffix.lower() not in FORMATS:
        raise RenderError(f"films end in {' or '.join(FORMATS)}, got {out.name!r}")
    usual_size, usual_fps = DEFAULTS[out.suffix.lower()]
    size, fps = size or usual_size, fps or usual_fps
    if min(size) < 64 or max(size) > _WIDEST or size[0] % 2 or size[1] % 2 or not 1 <= fps <= _FASTEST:
        raise RenderError(
            f"even sizes of 64 to {_WIDEST} pixels and 1 to {_FASTEST} frames per second are allowed, "
            f"got {size} and {fps}"
        )
    chosen = backend or gl.working_backend()
    if chosen is None:
        raise RenderError(
            f"no OpenGL works here, neither {' nor '.join(gl.BACKENDS)}: run\n  {gl.INSTALL_COMMAND}"
        )
    with replacing(out) as temporary, tempfile.TemporaryDirectory(prefix="hipg-film-") as folder:
        np.save(Path(folder) / "rows.npy", np.asarray(rows, np.float64), allow_pickle=False)
        job = Job(
            spec=spec, agent=agent, out=str(temporary.resolve()),
            width=size[0], height=size[1], fps=fps, end_reason=end_reason,
        )  # fmt: skip
        (Path(folder) / "job.json").write_text(job.model_dump_json(), encoding="utf-8")
        _run_child(Path(folder), chosen, spec.task, progress)


def write_poster(video: Path, out: Path, seconds: float = 2.5) -> bool:
    """Write a film's picture some seconds after its beginning as a JPEG; False if there is none.

    Pages show it until a film is played: browsers show a black picture otherwise.
    """
    import imageio_ffmpeg

    exact = ("-fflags", "+bitexact", "-flags:v", "+bitexact", "-map_metadata", "-1", "-threads", "1")
    command = [
        imageio_ffmpeg.get_ffmpeg_exe(), "-v", "error", "-ss", f"{seconds}", "-i", str(video),
        "-frames:v", "1", "-q:v", "4", *exact, "-f", "image2pipe", "-c:v", "mjpeg", "-",
    ]  # fmt: skip
    done = subprocess.run(command, capture_output=True, check=False, stdin=subprocess.DEVNULL)
    if not done.stdout:
        return False
    with replacing(out) as temporary:
        temporary.write_bytes(done.stdout)
    return True


def _run_child(folder: Path, backend: str, task: str, progress: Progress | None) -> None:
    """Render in a child process; end it if it hangs.

    Raises:
        RenderError: it failed, with its last words.
    """
    command = processes.python("-m", __spec__.name, str(folder), str(os.getpid()))
    with (folder / "stderr").open("w+b") as said:
        ear, mouth = os.pipe()
        with open(ear, "rb", buffering=0) as pipe, open(mouth, "wb") as child_end:
            child = subprocess.Popen(
                command, env=gl.environment(backend), cwd="/", stdout=child_end, stderr=said
            )
            child_end.close()
            try:
                hung = not _listen(pipe, progress)
            finally:
                child.kill()
                code = child.wait()
        if hung:
            raise RenderError(f"{task}: no frame within {_STALL:.0f} s from {backend}; its driver hangs")
        if not (folder / "done").exists():
            said.seek(0)
            why = gl.last_words(said.read().decode(errors="replace"), code)
            raise RenderError(f"{task}: no film with {backend}: {why}{gl.advice(why)}")


def _listen(pipe: io.FileIO, progress: Progress | None) -> bool:
    """Follow the child's count of frames to its end; False where it fell silent."""
    while True:
        ready, _, _ = select.select([pipe], [], [], _STALL)
        if not ready:
            return False
        line = pipe.readline()
        if not line:
            return True
        count = line.split()
        if progress and len(count) == 2:
            progress(int(count[0]), int(count[1]))


def moments(times: Float[np.ndarray, "K"], pace: float, fps: int) -> Float[np.ndarray, "frames"]:
    """Times at which frames are taken, from the first row to the last, s."""
    first, last = float(times[0]), float(times[-1])
    count = max(1, round((last - first) / pace * fps))
    return first + (last - first) * np.arange(count + 1) / count if last > first else np.array([first])


def pace_of(spec: TaskSpec) -> float:
    """Seconds of the world per second of film."""
    return 0.5 if spec.horizon * spec.control_step <= _SHORT else 1.0


def _frames(job: Job, rows: Float[np.ndarray, "K R"]) -> Iterator[tuple[bytes, int]]:
    """Every frame's pixels, with the number of frames of the film."""
    # graphics are touched here and in the child only
    from hipg_bench.rendering.hud import Caption, Hud, Reading
    from hipg_bench.rendering.motion import Trajectory
    from hipg_bench.rendering.renderer import Renderer, View, views
    from hipg_bench.rendering.scene import Scene

    trajectory = Trajectory(job.spec, rows)
    scene = Scene(trajectory)
    duration, pace = job.spec.horizon * job.spec.control_step, pace_of(job.spec)
    caption = Caption(job.spec.task, job.agent, scene.legend, pace, duration, scene.visuals.colour)
    hud = Hud(caption, job.width, job.height)
    times = moments(trajectory.time, pace, job.fps)
    held = round(_CARD * job.fps)
    total = len(times) + held

    def painted(composed: Iterator[View]) -> Iterator[tuple[View, np.ndarray]]:
        with Renderer(trajectory.model, job.width, job.height) as renderer:
            for view in composed:
                yield view, renderer.render(view.mjv_scene)

    picture = hud.blank
    # while a view is painted, the next one is composed and the one before is written on and encoded
    for view, frame in ahead(painted(ahead(views(scene, times.tolist(), job.height)))):
        now = trajectory.remembered(view.time)
        reading = Reading(view.time, float(now["episode_return"]), now["health"], view.status)
        picture = hud.write(frame, view.camera, view.labels, reading)
        yield picture.tobytes(), total
    headline, lines = _ending(job, trajectory.remembered(trajectory.time[-1]))
    for k in range(held):
        share = min(1.0, (k + 1) / max(1, round(_FADE_IN * job.fps)))
        yield hud.end_card(picture, share, headline, lines).tobytes(), total


def ahead(items: Iterator[T]) -> Iterator[T]:
    """The same items, each made in a thread of its own while the one before is dealt with."""
    with ThreadPoolExecutor(1) as maker:
        coming = maker.submit(next, items, None)
        while (item := coming.result()) is not None:
            coming = maker.submit(next, items, None)
            yield item


def _ending(job: Job, end: Mapping[str, np.ndarray]) -> tuple[str, tuple[str, str]]:
    """What the end card says."""
    finished = end["elapsed"] >= job.spec.horizon
    reason = job.end_reason or ("horizon" if finished else "")
    headline = _ENDS.get(reason, reason) or "the episode is over"
    alive = int((end["health"] > 0).sum())
    return headline[0].upper() + headline[1:], (
        f"team return {float(end['episode_return']):.1f}",
        f"{alive} of {job.spec.num_agents} agents alive",
    )


def _encoder(job: Job) -> Any:
    """A generator that takes frames and writes the file; the same frames give the same bytes."""
    import imageio_ffmpeg

    if job.out.lower().endswith(".gif"):
        codec = "gif"
        frames = (job.spec.horizon * job.spec.control_step / pace_of(job.spec) + _CARD) * job.fps
        if 4 * job.width * job.height * frames <= _MOST_GIF_BYTES:
            palette = "palettegen=stats_mode=diff[p];[b][p]paletteuse=dither=bayer:bayer_scale=5"
            palette += ":diff_mode=rectangle"
        else:
            # a palette per frame keeps the encoder's memory at one frame
            palette = "palettegen=stats_mode=single[p];[b][p]paletteuse=new=1:dither=bayer"
        options = ["-vf", f"split[a][b];[a]{palette}"]
    else:
        codec = "libx264"
        options = ["-crf", "20", "-preset", "veryfast", "-movflags", "+faststart", "-threads", "1"]
    return imageio_ffmpeg.write_frames(
        job.out,
        (job.width, job.height),
        fps=job.fps,
        codec=codec,
        quality=None,  # pyright: ignore[reportArgumentType] (its default is 5; None leaves it to -crf)
        macro_block_size=2,
        pix_fmt_out="pal8" if codec == "gif" else "yuv420p",
        output_params=[*options, "-fflags", "+bitexact", "-flags:v", "+bitexact", "-map_metadata", "-1"],
        ffmpeg_log_level="error",
    )


def _film(folder: Path, parent: int) -> None:
    """Make the film, count frames on standard output; give up when the parent is gone."""
    job = Job.model_validate_json((folder / "job.json").read_text(encoding="utf-8"))
    rows = np.load(folder / "rows.npy", allow_pickle=False)
    encoder = _encoder(job)
    encoder.send(None)
    with contextlib.closing(encoder):
        for count, (frame, total) in enumerate(_frames(job, rows), start=1):
            if os.getppid() != parent:
                half = Path(job.out)
                half.unlink(missing_ok=True)
                if half.parent.name.startswith(PARTIAL):
                    half.parent.rmdir()
                return
            encoder.send(frame)
            sys.stdout.write(f"{count} {total}\n")
            sys.stdout.flush()
    (folder / "done").touch()


if __name__ == "__main__":
    try:
        _film(Path(sys.argv[1]), int(sys.argv[2]))
    except HipgError as error:
        sys.exit(f"{type(error).__name__}: {error}")
