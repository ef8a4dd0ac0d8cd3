"""Watching a team play, in MuJoCo's interactive viewer, dressed as in films."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Iterator

import mujoco
import mujoco.viewer
import numpy as np
from jaxtyping import Float

from hipg_bench.errors import RenderError
from hipg_bench.rendering.motion import Trajectory
from hipg_bench.rendering.scene import Scene
from hipg_bench.spec import TaskSpec

_FRAME = 1 / 60
"""Seconds between pictures."""
_PAUSE = 1.0
"""Seconds for which the end of an episode stays in view."""


def check_display() -> None:
    """Say what to do where no window can be opened.

    Raises:
        RenderError: there is no display.
    """
    needs_x = sys.platform.startswith("linux")
    if needs_x and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise RenderError(
            "the viewer opens a window, and there is no display (DISPLAY is not set): run it on a desktop "
            "or through `ssh -X`, or make a film instead with `hipg-bench video`"
        )


def watch(spec: TaskSpec, rows: Iterator[Float[np.ndarray, "R"]], *, speed: float = 1.0) -> None:
    """Show episodes as they are played, until the window is closed or the rows end.

    The picture lags one control step behind the play, so that it can move between rows.

    Args:
        spec: the task.
        rows: the start of an episode, then its control steps, then the next episode.
        speed: seconds of the world per second.

    Raises:
        RenderError: no display, or no look for the task's family.
    """
    check_display()
    trajectory = Trajectory(spec, next(rows)[None])
    scene = Scene(trajectory)
    scene.update(0.0)
    with mujoco.viewer.launch_passive(
        trajectory.model, trajectory.data, show_left_ui=False, show_right_ui=False
    ) as window:
        camera = scene.camera(0.0)
        window.cam.lookat[:] = camera.target
        window.cam.distance, window.cam.azimuth = camera.distance, camera.azimuth
        window.cam.elevation = camera.elevation
        due = time.monotonic()
        for row in rows:
            trajectory.append(row)
            if len(trajectory.rows) == 1:
                due += _PAUSE
                continue
            start, end = (float(moment) for moment in trajectory.time[-2:])
            pictures = max(1, round((end - start) / speed / _FRAME))
            for k in range(1, pictures + 1):
                if not window.is_running():
                    return
                _draw(window, scene, start + (end - start) * k / pictures)
                due += (end - start) / speed / pictures
                time.sleep(max(0.0, due - time.monotonic()))
            due = max(due, time.monotonic() - 2 * _FRAME)  # a slow machine plays slowly, it never skips


def _draw(window: mujoco.viewer.Handle, scene: Scene, moment: float) -> None:
    with window.lock():
        before = scene.visuals.middle
        scene.update(moment)
        if scene.travels:
            window.cam.lookat[:2] += (scene.visuals.middle - before)[:2]
        mjv_scene = window.user_scn
        mjv_scene.ngeom = 0
        _, status = scene.decorate(mjv_scene, moment)
    now = scene.trajectory.remembered(moment)
    alive = int((now["health"] > 0).sum())
    words = {
        "time": f"{moment:.1f} s",
        "return": f"{float(now['episode_return']):.1f}",
        "alive": f"{alive} of {scene.trajectory.num_agents}",
        **{line.text: "" for line in status},
    }
    window.set_texts((None, None, "\n".join(words), "\n".join(words.values())))
    window.sync()
