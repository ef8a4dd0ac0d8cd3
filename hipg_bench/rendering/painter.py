"""Drawing into a MuJoCo mjv_scene: balls, lines, rings and boxes that are in no model, and labels."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable

import mujoco
import numpy as np

from hipg_bench.errors import RenderError
from hipg_bench.rendering.camera import Camera, focal_length

Point = np.ndarray | tuple[float, float, float]
"""A place, m."""
Colour = np.ndarray | tuple[float, ...]
"""Red, green, blue in [0, 1]."""

_UPRIGHT = np.eye(3).ravel()
_NOWHERE = np.zeros(3)
_THIN = 0.0075
"""Rods up to this radius, m, are drawn as strokes: round ones cost hundreds of times as many triangles."""
_SHEER = 0.99
"""MuJoCo draws strokes that are quite opaque in white."""


@dataclasses.dataclass(frozen=True)
class Label:
    """A word at a place in the world, written on the picture.

    Attributes:
        place: m.
        text: the word.
        colour: red, green, blue in [0, 1].
        strong: bold.
    """

    place: np.ndarray
    text: str
    colour: tuple[float, ...]
    strong: bool = False


class Painter:
    """Adds geoms to a scene until it is full, for a camera and a picture so many pixels high.

    Attributes:
        labels: what was written so far.
    """

    def __init__(self, mjv_scene: mujoco.MjvScene, camera: Camera, height: int) -> None:
        self._mjv_scene = mjv_scene
        self._eye = camera.target - camera.distance * camera.ahead
        self._ahead = camera.ahead
        self._focal = focal_length(height)
        self.labels: list[Label] = []

    def ball(
        self, place: Point, radius: float, colour: Colour, alpha: float = 1.0, glow: float = 0.6
    ) -> None:
        """A sphere."""
        self._add(mujoco.mjtGeom.mjGEOM_SPHERE, (radius,) * 3, place, _UPRIGHT, colour, alpha, glow)

    def disc(
        self, place: Point, radius: float, colour: Colour, alpha: float = 1.0, glow: float = 0.3
    ) -> None:
        """A flat horizontal disc; an ellipsoid has a third of a cylinder's triangles."""
        size = (radius, radius, 0.0005)
        self._add(mujoco.mjtGeom.mjGEOM_ELLIPSOID, size, place, _UPRIGHT, colour, alpha, glow)

    def box(self, place: Point, half: Point, colour: Colour, alpha: float = 1.0, glow: float = 0.0) -> None:
        """A box along the world's axes."""
        self._add(mujoco.mjtGeom.mjGEOM_BOX, tuple(half), place, _UPRIGHT, colour, alpha, glow)

    def line(
        self, start: Point, end: Point, width: float, colour: Colour, alpha: float = 1.0, glow: float = 0.8
    ) -> None:
        """A round rod of radius ``width``, m; nothing where both ends are in one place."""
        start, end = np.asarray(start, np.float64), np.asarray(end, np.float64)
        if float(np.linalg.norm(end - start)) < 1e-6:
            return
        if width > _THIN:
            kind = mujoco.mjtGeom.mjGEOM_CAPSULE
            geom = self._add(kind, (width,) * 3, _NOWHERE, _UPRIGHT, colour, alpha, glow)
            mujoco.mjv_connector(geom, int(kind), width, start, end)
            return
        kind = mujoco.mjtGeom.mjGEOM_LINE
        geom = self._add(kind, (width,) * 3, _NOWHERE, _UPRIGHT, colour, min(alpha, _SHEER), 0.0)
        depth = max(0.1, float(((start + end) / 2 - self._eye) @ self._ahead))
        mujoco.mjv_connector(geom, int(kind), max(1.0, 2 * width * self._focal / depth), start, end)

    def dashes(
        self,
        start: Point,
        end: Point,
        width: float,
        colour: Colour,
        alpha: float = 1.0,
        *,
        dash: float = 0.05,
    ) -> None:
        """A line of dashes of about the given length, m."""
        start, end = np.asarray(start, np.float64), np.asarray(end, np.float64)
        count = max(1, round(float(np.linalg.norm(end - start)) / (2 * dash)))
        for k in range(count):
            a, b = (k + 0.25) / count, (k + 0.75) / count
            self.line(start + a * (end - start), start + b * (end - start), width, colour, alpha)

    def ring(
        self,
        place: Point,
        radius: float,
        width: float,
        colour: Colour,
        alpha: float = 1.0,
        *,
        axes: tuple[Point, Point] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0)),
        pieces: int = 40,
        dashed: bool = False,
        turn: float = 0.0,
    ) -> None:
        """A circle in the plane of two unit vectors, made of straight pieces; ``turn`` in radians."""
        angle = turn + 2 * np.pi * np.arange(pieces + 1)[:, None] / pieces
        rim = np.asarray(place) + radius * (
            np.cos(angle) * np.asarray(axes[0]) + np.sin(angle) * np.asarray(axes[1])
        )
        for k in range(0, pieces, 2 if dashed else 1):
            self.line(rim[k], rim[k + 1], width, colour, alpha)

    def trail(self, places: np.ndarray, width: float, colour: Colour, alpha: float) -> None:
        """A path (points, 3) that thickens and brightens towards its last point."""
        for k in range(len(places) - 1):
            share = (k + 1) / (len(places) - 1)
            self.line(places[k], places[k + 1], width * (0.35 + 0.65 * share), colour, alpha * share**1.5)

    def edges(self, low: Point, high: Point, width: float, colour: Colour, alpha: float) -> None:
        """The twelve edges of a box."""
        corners = np.stack([np.asarray(low), np.asarray(high)])
        for axis in range(3):
            first, second = (k for k in range(3) if k != axis)
            for i, j in ((0, 0), (0, 1), (1, 0), (1, 1)):
                start, end = corners[0].copy(), corners[1].copy()
                start[[first, second]] = end[[first, second]] = corners[i, first], corners[j, second]
                self.line(start, end, width, colour, alpha, glow=0.4)

    def write(self, place: Point, text: str, colour: Iterable[float], *, strong: bool = False) -> None:
        """Put a word at a place."""
        self.labels.append(Label(np.array(place, np.float64), text, tuple(map(float, colour)), strong))

    def _add(
        self,
        kind: mujoco.mjtGeom,
        size: tuple[float, ...],
        place: Point,
        turn: np.ndarray,
        colour: Colour,
        alpha: float,
        glow: float,
    ) -> mujoco.MjvGeom:
        """Add one geom.

        Raises:
            RenderError: the scene is full.
        """
        mjv_scene = self._mjv_scene
        if mjv_scene.ngeom >= mjv_scene.maxgeom:
            raise RenderError(f"a picture holds at most {mjv_scene.maxgeom} shapes")
        geom = mjv_scene.geoms[mjv_scene.ngeom]
        mjv_scene.ngeom += 1
        # what glows is also lit: keep the sum within range, or hues wash out
        rgba = np.array([*(np.asarray(colour) / (1.0 + 0.9 * glow)), alpha], np.float32)
        mujoco.mjv_initGeom(
            geom, int(kind), np.asarray(size, np.float64), np.asarray(place, np.float64), turn, rgba
        )
        geom.emission = glow
        geom.specular = 0.0
        geom.category = int(mujoco.mjtCatBit.mjCAT_DECOR)
        return geom
