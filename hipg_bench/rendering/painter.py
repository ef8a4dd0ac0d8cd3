"""From a stage to pixels: views are composed on any thread, and painted on the one that holds OpenGL."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterable, Iterator, Sequence
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


@dataclasses.dataclass(frozen=True)
class View:
    """The world at one time, ready to be painted.

    Attributes:
        time: s.
        scene: every shape.
        camera: where it is seen from.
        labels: words at places in the world, still to be written on the picture.
        status: words beside it.
    """

    time: float
    scene: mujoco.MjvScene
    camera: Camera
    labels: Sequence[Label]
    status: Sequence[Status]


def views(stage: Stage, times: Iterable[float], height: int) -> Iterator[View]:
    """The stage at one time after another, for pictures so many pixels high.

    Two scenes take turns: one is painted while the next view is composed in the other.
    """
    model, data = stage.footage.model, stage.footage.data
    scenes = itertools.cycle([mujoco.MjvScene(model, _SHAPES) for _ in range(2)])
    everything, option = int(mujoco.mjtCatBit.mjCAT_ALL), mujoco.MjvOption()
    for time, scene in zip(times, scenes, strict=False):
        stage.dress(time)
        camera = stage.camera(time)
        eye = camera.mujoco()
        # else the headlight would shine from where this scene was seen from last
        mujoco.mjv_updateCamera(model, data, eye, scene)
        mujoco.mjv_updateScene(model, data, option, None, eye, everything, scene)
        # suns and their shadows travel with the camera
        for light in scene.lights[: scene.nlight]:
            if not light.headlight:
                light.pos[:2] += camera.target[:2]
        scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = 0
        # it would be drawn first, everywhere, and then hidden by the floor
        scene.flags[mujoco.mjtRndFlag.mjRND_SKYBOX] = camera.sees_sky
        yield View(time, scene, camera, *stage.decorate(scene, time, height))


class Painter:
    """Paints scenes of one model; a context manager, since it holds an OpenGL context of its thread."""

    def __init__(self, model: mujoco.MjModel, width: int, height: int) -> None:
        # the off-screen buffer bounds the picture
        model.vis.global_.offwidth, model.vis.global_.offheight = width, height
        model.vis.quality.offsamples = _SAMPLES
        self._opengl = mujoco.GLContext(width, height)
        self._opengl.make_current()
        self._context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._context)
        self._canvas = mujoco.MjrRect(0, 0, width, height)
        self._upside_down = np.empty((height, width, 3), np.uint8)

    def __enter__(self) -> Painter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._context.free()
        self._opengl.free()

    def paint(self, scene: mujoco.MjvScene) -> UInt8[np.ndarray, "height width 3"]:
        """Pixels of a scene, the caller's to keep."""
        mujoco.mjr_render(self._canvas, scene, self._context)
        mujoco.mjr_readPixels(self._upside_down, None, self._canvas, self._context)
        return self._upside_down[::-1].copy()
