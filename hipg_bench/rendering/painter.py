"""From a stage to pixels, by MuJoCo's renderer."""

from __future__ import annotations

from types import TracebackType

import mujoco
import numpy as np
from jaxtyping import UInt8

from hipg_bench.rendering.brush import Label
from hipg_bench.rendering.camera import Camera
from hipg_bench.rendering.look import Status
from hipg_bench.rendering.scene import Stage

_SHAPES = 8000
"""Geoms a picture may hold."""
_SAMPLES = 4
"""Per pixel, against jagged edges."""


class Painter:
    """Renders one stage; a context manager, since it holds an OpenGL context."""

    def __init__(self, stage: Stage, width: int, height: int) -> None:
        self._stage = stage
        model = stage.footage.model
        # the off-screen buffer bounds the picture
        model.vis.global_.offwidth, model.vis.global_.offheight = width, height
        model.vis.quality.offsamples = _SAMPLES
        self._renderer = mujoco.Renderer(model, height, width, max_geom=_SHAPES)
        flags = mujoco.mjtRndFlag
        self._renderer.scene.flags[flags.mjRND_REFLECTION] = 0
        self._light = [np.zeros(3) for _ in range(model.nlight)]

    def __enter__(self) -> Painter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._renderer.close()

    def paint(
        self, time: float
    ) -> tuple[UInt8[np.ndarray, "height width 3"], Camera, list[Label], list[Status]]:
        """The world at a time, with its camera, and what is still to be written on it."""
        stage, renderer = self._stage, self._renderer
        stage.dress(time)
        camera = stage.camera(time)
        renderer.update_scene(stage.footage.data, camera=camera.mujoco())
        scene = renderer.scene
        # suns and their shadows travel with the camera
        for light in scene.lights[: scene.nlight]:
            if not light.headlight:
                light.pos[:2] += camera.target[:2]
        labels, status = stage.decorate(scene, time, self._renderer.height)
        return renderer.render().copy(), camera, labels, status
