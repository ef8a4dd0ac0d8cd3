"""From a scene to pixels: views are composed on any thread, and painted on the one that holds OpenGL."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterable, Iterator, Sequence
from types import TracebackType

import mujoco
import numpy as np
from jaxtyping import UInt8
from PIL import Image

from hipg_bench.rendering.camera import Camera
from hipg_bench.rendering.look import Status
from hipg_bench.rendering.painter import Label
from hipg_bench.rendering.scene import Scene

_SHAPES = 8000
"""Geoms a picture may hold."""
_OVERSAMPLING = 1.5
"""Pixels that are painted for each pixel of a picture, per axis, against jagged edges.

Without a graphics card that takes half to two thirds of the time that MuJoCo's four samples per pixel take.
"""
_TALLEST = 2880
"""Pixels of a picture; taller ones are painted as they are, since OpenGL bounds the canvas."""
_FINE_HEIGHT = 720
"""Smaller pictures are made of coarser shapes and shadows, which nobody can tell apart."""


@dataclasses.dataclass(frozen=True)
class View:
    """The world at one time, ready to be painted.

    Attributes:
        time: s.
        mjv_scene: every shape.
        camera: where it is seen from.
        labels: words at places in the world, still to be written on the picture.
        status: words beside it.
    """

    time: float
    mjv_scene: mujoco.MjvScene
    camera: Camera
    labels: Sequence[Label]
    status: Sequence[Status]


def _scale(height: int) -> float:
    """Pixels of the canvas for each pixel of a picture so many pixels high, per axis."""
    return _OVERSAMPLING if height <= _TALLEST else 1.0


def views(scene: Scene, times: Iterable[float], height: int) -> Iterator[View]:
    """The scene at one time after another, for pictures so many pixels high.

    Two scenes take turns: one is painted while the next view is composed in the other.
    """
    model, data = scene.trajectory.model, scene.trajectory.data
    scenes = itertools.cycle([mujoco.MjvScene(model, _SHAPES) for _ in range(2)])
    everything, option = int(mujoco.mjtCatBit.mjCAT_ALL), mujoco.MjvOption()
    for time, mjv_scene in zip(times, scenes, strict=False):
        scene.update(time)
        camera = scene.camera(time)
        eye = camera.mujoco()
        # else the headlight would shine from where this scene was seen from last
        mujoco.mjv_updateCamera(model, data, eye, mjv_scene)
        mujoco.mjv_updateScene(model, data, option, None, eye, everything, mjv_scene)
        # suns and their shadows travel with the camera
        for light in mjv_scene.lights[: mjv_scene.nlight]:
            if not light.headlight:
                light.pos[:2] += camera.target[:2]
        mjv_scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = 0
        # it would be drawn first, everywhere, and then hidden by the floor
        mjv_scene.flags[mujoco.mjtRndFlag.mjRND_SKYBOX] = camera.sees_sky
        yield View(time, mjv_scene, camera, *scene.decorate(mjv_scene, time, round(height * _scale(height))))


class Renderer:
    """Paints scenes of one model; a context manager, since it holds an OpenGL context of its thread."""

    def __init__(self, model: mujoco.MjModel, width: int, height: int) -> None:
        self._size = (width, height)
        scale = _scale(height)
        width, height = round(width * scale), round(height * scale)
        # the off-screen buffer bounds the picture
        model.vis.global_.offwidth, model.vis.global_.offheight = width, height
        quality = model.vis.quality
        quality.offsamples = 0 if scale > 1 else 4
        if self._size[1] < _FINE_HEIGHT:
            quality.shadowsize, quality.numslices, quality.numstacks = 1024, 16, 8
        self._opengl = mujoco.GLContext(width, height)
        self._opengl.make_current()
        self._context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._context)
        self._canvas = mujoco.MjrRect(0, 0, width, height)
        self._upside_down = np.empty((height, width, 3), np.uint8)

    def __enter__(self) -> Renderer:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._context.free()
        self._opengl.free()

    def render(self, mjv_scene: mujoco.MjvScene) -> UInt8[np.ndarray, "height width 3"]:
        """Pixels of a mjv_scene, the caller's to keep."""
        mujoco.mjr_render(self._canvas, mjv_scene, self._context)
        mujoco.mjr_readPixels(self._upside_down, None, self._canvas, self._context)
        picture = self._upside_down[::-1]
        if picture.shape[1::-1] == self._size:
            return picture.copy()
        return np.array(Image.fromarray(picture).resize(self._size, Image.Resampling.BOX))
