"""Which OpenGL works here: each backend is tried for real, by rendering a frame in a child process.

MuJoCo chooses its backend when it is first imported, and a broken driver may hang or crash; hence
the child. This module is also that child: ``python -m hipg_bench.rendering.gl``.
"""

from __future__ import annotations

import contextlib
import ctypes
import dataclasses
import functools
import json
import os
import subprocess
import sys
import time

from hipg_bench import processes

BACKENDS = ("egl", "osmesa")
"""In order of preference: EGL also finds GPUs, OSMesa is software only."""
NAMES = (
    "", "egl", "osmesa", "glfw", "glx", "wgl", "cgl", "disable", "disabled", "off", "false", "0", "enable",
    "enabled", "on", "true", "1",
)  # fmt: skip
"""What ``MUJOCO_GL`` may be: with anything else MuJoCo cannot be imported."""
INSTALL_COMMAND = "apt-get install -y libegl1 libgl1-mesa-dri libosmesa6"
"""What to run on Debian or Ubuntu when no backend works."""

_PATIENCE = 60.0
"""Seconds after which a driver counts as hung."""


@dataclasses.dataclass(frozen=True)
class Probe:
    """What became of one frame.

    Attributes:
        backend: ``egl``, ``osmesa`` or ``glfw``.
        works: whether a frame with something on it came back.
        renderer: the driver's name for itself, e.g. ``llvmpipe (LLVM 15.0.6, 256 bits)``.
        seconds: wall time of the child, start-up included.
        error: last line of what went wrong; empty where it works.
    """

    backend: str
    works: bool
    renderer: str
    seconds: float
    error: str


def choose_without_display() -> None:
    """Let libraries that draw in this process use what works without a display, unless the user chose."""
    if os.environ.get("MUJOCO_GL") or os.environ.get("DISPLAY") or sys.platform != "linux":
        return
    for backend, library in (("egl", "libEGL.so.1"), ("osmesa", "libOSMesa.so.8")):
        with contextlib.suppress(OSError):
            ctypes.CDLL(library)
            os.environ["MUJOCO_GL"] = backend
            return


def environment(backend: str) -> dict[str, str]:
    """Environment variables under which a child process renders with ``backend``."""
    # software rendering: leave half of the cores to a film beside this one
    threads = str(max(1, processes.usable_cores() // 2))
    threads = os.environ.get("LP_NUM_THREADS", threads)
    return processes.environment(
        LP_NUM_THREADS=threads, MUJOCO_GL=backend, PYOPENGL_PLATFORM=backend, OMP_NUM_THREADS="1"
    )


def probe(backend: str) -> Probe:
    """Render one small frame with ``backend`` in a child process."""
    start = time.perf_counter()
    command = processes.python("-m", __name__)
    try:
        done = subprocess.run(
            command,
            env=environment(backend),
            cwd="/",
            capture_output=True,
            text=True,
            timeout=_PATIENCE,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return Probe(backend, False, "", _PATIENCE, f"no frame within {_PATIENCE:.0f} s")
    seconds = time.perf_counter() - start
    if done.returncode == 0:
        return Probe(backend, True, json.loads(done.stdout.splitlines()[-1])["renderer"], seconds, "")
    return Probe(backend, False, "", seconds, last_words(done.stderr, done.returncode))


def last_words(stderr: str, code: int) -> str:
    """The line that says why a child process failed."""
    said = [line.strip() for line in stderr.splitlines() if line.strip() and not line.startswith(" ")]
    # exceptions that are raised while a renderer is torn down come after the one that matters
    said = [line for line in said if not line.startswith(("Exception ignored", "Traceback"))]
    errors = [line for line in said if "Error" in line]
    ended = f"ended by signal {-code}" if code < 0 else f"ended with code {code}"
    return (errors or ([] if code < 0 else said) or [ended])[-1]


def advice(why: str) -> str:
    """What to install, where a child process failed because OpenGL is missing; else nothing."""
    missing = any(word in why for word in ("OpenGL", "EGL", "OSMesa", "libGL", "GLError", "GLFW"))
    return f"\nIf OpenGL is missing: {INSTALL_COMMAND}" if missing else ""


@functools.cache
def working_backend(backends: tuple[str, ...] = BACKENDS) -> str | None:
    """First backend that really renders here, or None; tried once per process.

    A valid ``MUJOCO_GL`` in the environment is tried before the others.
    """
    wish = os.environ.get("MUJOCO_GL", "").lower()
    order = sorted(backends, key=lambda backend: backend != wish)
    return next((backend for backend in order if probe(backend).works), None)


def _render_frame() -> str:
    """Render a lit ball; return the driver's name.

    Raises:
        RuntimeError: the frame came back empty.
    """
    import mujoco  # the backend is fixed here
    from OpenGL import GL  # pyright: ignore[reportMissingImports]

    model = mujoco.MjModel.from_xml_string(
        "<mujoco><worldbody><light pos='0 0 3'/><geom type='sphere' size='.5'/></worldbody></mujoco>"
    )
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    with mujoco.Renderer(model, 48, 64) as renderer:
        renderer.update_scene(data)
        frame = renderer.render()
        if frame.std() < 1.0:
            raise RuntimeError("RenderError: the frame came back empty")
        name: bytes | None = GL.glGetString(GL.GL_RENDERER)
        return name.decode() if name else "unknown"


if __name__ == "__main__":
    sys.stdout.write(json.dumps({"renderer": _render_frame()}) + "\n")
