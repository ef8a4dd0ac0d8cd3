"""Worlds shown while they are played: a picture when asked, or a window.

OpenGL lives in a child process, which is this module, ``python -m hipg_bench.rendering.live``: it can choose
its backend whatever the process that plays has imported, and a broken driver cannot take that down. Rows go
in through its standard input, each message led by their number and size; through its standard output come a
picture's bytes, or one byte when the window takes a row.
"""

from __future__ import annotations

import base64
import contextlib
import io
import itertools
import os
import select
import struct
import subprocess
import sys
import tempfile
import threading
import weakref
from collections.abc import Iterator
from typing import IO, Any, Literal, cast

import numpy as np
from jaxtyping import Float, UInt8

from hipg_bench import processes
from hipg_bench.errors import HipgError, RenderError
from hipg_bench.rendering import gl
from hipg_bench.spec import Params, TaskSpec

SIZE = (640, 360)
"""Width and height of pictures."""

_HEAD = struct.Struct("<II")
"""How many rows, and of how many numbers."""
_STALL = 120.0
"""Seconds without an answer after which the child counts as hung."""


class Job(Params):
    """What the child must know before the first row.

    Attributes:
        spec: the task.
        mode: a window, a picture of an episode up to now, or a picture of one row by itself.
        size: width and height of pictures.
    """

    spec: TaskSpec
    mode: Literal["human", "rgb_array", "still"]
    size: tuple[int, int] = SIZE


class Live:
    """Shows one world; its child starts with the first picture and ends with `close`."""

    def __init__(self, spec: TaskSpec, mode: str) -> None:
        """Prepare, without OpenGL as yet.

        Raises:
            RenderError: no such mode, or a window where there is no display.
        """
        if mode not in ("human", "rgb_array"):
            raise RenderError(f"{spec.task}: render modes 'human' and 'rgb_array' are allowed, got {mode!r}")
        if mode == "human":
            from hipg_bench.rendering.viewer import check_display

            check_display()
        self._job = Job(spec=spec, mode=mode)
        self._unseen: list[Float[np.ndarray, "R"]] = []
        self._last: Float[np.ndarray, "R"] | None = None
        self._child: _Child | None = None
        self._shows = False
        self._lock = threading.Lock()

    def __reduce__(self) -> tuple[Any, ...]:
        """A copy shows the same world, in a child of its own."""
        return _copied, (self._job.spec, self._job.mode, self._shows, self._last)

    def begin(self, row: Float[np.ndarray, "R"]) -> None:
        """An episode starts: forget what nobody asked to see of the last one."""
        self._unseen.clear()
        self._shows = True
        self.see(row)

    def see(self, row: Float[np.ndarray, "R"]) -> None:
        """The world after a control step; a window shows it, at the pace of the world, until it is closed."""
        self._unseen.append(row)
        self._last = row
        if self._job.mode == "human" and self._shows:
            self._shows = bool(self._ask(1))

    def picture(self) -> UInt8[np.ndarray, "height width 3"]:
        """The world as it was last seen.

        Raises:
            RenderError: no episode has begun, no OpenGL works here, or the child failed.
        """
        if not self._shows:
            raise RenderError(f"{self._job.spec.task}: nothing to render before reset() and after close()")
        with self._lock:
            return _pixels(self._ask(_bytes(SIZE)), SIZE)

    def close(self) -> None:
        """End the child."""
        if self._child:
            self._child.end()
        self._child, self._shows = None, False

    def _ask(self, size: int) -> bytes:
        """Send the rows that the child has not seen; its answer, empty where its window was closed."""
        self._child = _own(self._child)
        if self._child is None:
            self._child = _Child(self._job)
            self._unseen = self._unseen or ([] if self._last is None else [self._last])
        rows = np.stack(self._unseen) if self._unseen else np.empty((0, 0))
        self._unseen.clear()
        try:
            return self._child.ask(_HEAD.pack(*rows.shape) + rows.tobytes(), size)
        except RenderError:
            self._child.end()
            self._child = None  # the next picture comes from another one
            raise


class Stills:
    """Pictures of single rows, each by itself: the same row gives the same picture."""

    def __init__(self, spec: TaskSpec) -> None:
        """Prepare, without OpenGL as yet."""
        self._spec = spec
        self._child: _Child | None = None
        self._size = SIZE
        self._lock = threading.Lock()

    def picture(
        self, row: Float[np.ndarray, "R"], size: tuple[int, int] = SIZE
    ) -> UInt8[np.ndarray, "height width 3"]:
        """The world that a row holds; width and height in pixels.

        Raises:
            RenderError: no OpenGL works here, or the child failed.
        """
        with self._lock:
            self._child = _own(self._child)
            if self._size != size:
                self.close()
            if self._child is None:
                self._child = _Child(Job(spec=self._spec, mode="still", size=size))
                self._size = size
            try:
                answer = self._child.ask(_HEAD.pack(1, len(row)) + row.tobytes(), _bytes(size))
            except BaseException:
                self.close()  # a late answer would be taken for the next one
                raise
            return _pixels(answer, size)

    def close(self) -> None:
        """End the child."""
        if self._child:
            self._child.end()
        self._child = None


def _bytes(size: tuple[int, int]) -> int:
    return size[0] * size[1] * 3


def _pixels(answer: bytes, size: tuple[int, int]) -> UInt8[np.ndarray, "height width 3"]:
    return np.frombuffer(answer, np.uint8).reshape(size[1], size[0], 3).copy()


def _own(child: _Child | None) -> _Child | None:
    """The child, but that of a process which this one was forked from is left to draw for it."""
    if child and child.parent != os.getpid():
        child.end.detach()
        return None
    return child


def png(picture: UInt8[np.ndarray, "height width 3"]) -> str:
    """A picture as base64 of a PNG file, for a page."""
    from PIL import Image

    file = io.BytesIO()
    Image.fromarray(picture).save(file, "png")
    return base64.b64encode(file.getvalue()).decode()


class _Child:
    """The process that draws, as seen by the one that plays; it ends with this object."""

    def __init__(self, job: Job) -> None:
        # a window takes the desktop's OpenGL, pictures the first that works without one
        backend = "glfw" if job.mode == "human" else gl.working_backend()
        if backend is None:
            raise RenderError(
                f"{job.spec.task}: no OpenGL works, neither {' nor '.join(gl.BACKENDS)}: run\n"
                f"  {gl.INSTALL_COMMAND}"
            )
        self._where = f"{job.spec.task}: {backend}"
        self.parent = os.getpid()
        self._stderr = tempfile.TemporaryFile()  # noqa: SIM115 (lives as long as the child)
        self._process = subprocess.Popen(
            processes.python("-m", __spec__.name, job.model_dump_json()),
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=self._stderr, env=gl.environment(backend),
            cwd="/",
        )  # fmt: skip
        self._mouth = cast("IO[bytes]", self._process.stdin)
        self._ear = cast("IO[bytes]", self._process.stdout)
        self.end = weakref.finalize(self, _end, self._process, self._mouth, self._ear, self._stderr)

    def ask(self, message: bytes, size: int) -> bytes:
        """Send a message; the answer of ``size`` bytes, or nothing where the child ended in peace.

        Raises:
            RenderError: it failed, with its last words, or hangs.
        """
        with contextlib.suppress(BrokenPipeError):
            self._mouth.write(message)
            self._mouth.flush()
        answer = bytearray()
        while len(answer) < size:
            if not select.select([self._ear], [], [], _STALL)[0]:
                raise RenderError(f"{self._where}: no picture within {_STALL:.0f} s; the driver hangs")
            part = os.read(self._ear.fileno(), size - len(answer))
            if not part:
                return self._last_words()
            answer += part
        return bytes(answer)

    def _last_words(self) -> bytes:
        code = self._process.wait()
        if code == 0:
            return b""
        self._stderr.seek(0)
        why = gl.last_words(self._stderr.read().decode(errors="replace"), code)
        raise RenderError(f"{self._where}: nothing can be shown: {why}{gl.advice(why)}")


def _copied(spec: TaskSpec, mode: str, shows: bool, last: Float[np.ndarray, "R"] | None) -> Live:
    made = Live(spec, mode)
    if shows and last is not None:
        made.begin(last)
    return made


def _end(process: subprocess.Popen[bytes], *files: IO[bytes]) -> None:
    process.kill()
    process.wait()
    for file in files:
        with contextlib.suppress(BrokenPipeError):
            file.close()


def _messages() -> Iterator[Float[np.ndarray, "k R"]]:
    """What the parent sends, until it is gone."""
    while head := sys.stdin.buffer.read(_HEAD.size):
        count, size = _HEAD.unpack(head)
        yield np.frombuffer(sys.stdin.buffer.read(count * size * 8)).reshape(count, size)


def _draw(job: Job, out: IO[bytes]) -> None:
    """Answer each message with a picture, written on as in films."""
    # graphics are touched here and in the child only
    from hipg_bench.rendering.hud import Caption, Hud, Reading
    from hipg_bench.rendering.motion import Trajectory
    from hipg_bench.rendering.renderer import Renderer, views
    from hipg_bench.rendering.scene import Scene

    messages = _messages()
    first = next(messages)
    spec = job.spec
    trajectory = Trajectory(spec, first[:1])
    scene = Scene(trajectory)
    duration = spec.horizon * spec.control_step
    hud = Hud(Caption(spec.task, "", scene.legend, 1.0, duration, scene.visuals.colour), *job.size)

    def latest() -> Iterator[float]:
        for rows in itertools.chain([first[1:]], messages):
            for row in rows:
                if job.mode == "still":
                    trajectory.load(row[None])
                else:
                    trajectory.append(row)
            yield float(trajectory.time[-1])

    with Renderer(trajectory.model, *job.size) as renderer:
        for view in views(scene, latest(), job.size[1]):
            now = trajectory.remembered(view.time)
            reading = Reading(view.time, float(now["episode_return"]), now["health"], view.status)
            frame = renderer.render(view.mjv_scene)
            out.write(hud.write(frame, view.camera, view.labels, reading).tobytes())
            out.flush()


def _taken(out: IO[bytes]) -> Iterator[Float[np.ndarray, "R"]]:
    """Rows one by one, each acknowledged when the window asks for it."""
    for rows in _messages():
        for row in rows:
            out.write(b"+")
            out.flush()
            yield row


def _main() -> None:
    job = Job.model_validate_json(sys.argv[1])
    # what libraries print must not get between the answers
    out = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    if job.mode == "human":
        from hipg_bench.rendering.viewer import watch

        watch(job.spec, _taken(out))
    else:
        _draw(job, out)


if __name__ == "__main__":
    try:
        _main()
    except HipgError as error:
        sys.exit(f"{type(error).__name__}: {error}")
