"""Where the camera stands, and where a place in the world falls on the picture."""

from __future__ import annotations

import dataclasses
import functools

import mujoco
import numpy as np
from jaxtyping import Float

FIELD_OF_VIEW = 38.0
"""Vertical, degrees; that of ``arena.xml``."""
_FLOOR = 19.0
"""Up to here the floor of ``arena.xml`` hides all behind it; farther on it fades into the sky, m."""


@dataclasses.dataclass(frozen=True)
class Camera:
    """A view that looks at a place.

    Attributes:
        target: the place, m.
        distance: from it, m.
        azimuth: 0 looks along +x, 90 along +y, degrees.
        elevation: negative looks down, degrees.
    """

    target: np.ndarray
    distance: float
    azimuth: float
    elevation: float

    @functools.cached_property
    def ahead(self) -> Float[np.ndarray, "3"]:
        """Where it looks, a unit vector."""
        azimuth, elevation = np.radians(self.azimuth), np.radians(self.elevation)
        level = np.cos(elevation)
        return np.array([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)])

    @property
    def sees_sky(self) -> bool:
        """Whether the upper edge of the picture looks beyond the floor."""
        eye = self.target[2] - self.distance * self.ahead[2]
        steepness = np.tan(np.radians(-self.elevation - FIELD_OF_VIEW / 2))
        return bool(eye > _FLOOR * steepness)

    def mujoco(self) -> mujoco.MjvCamera:
        """The same for MuJoCo."""
        camera = mujoco.MjvCamera()
        camera.type = int(mujoco.mjtCamera.mjCAMERA_FREE)
        camera.lookat[:] = self.target
        camera.distance, camera.azimuth, camera.elevation = self.distance, self.azimuth, self.elevation
        return camera

    def project(
        self, places: Float[np.ndarray, "n 3"], width: int, height: int
    ) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "n"]]:
        """Pixels from the upper left corner, and depth along the view, m (negative behind the camera)."""
        ahead, azimuth = self.ahead, np.radians(self.azimuth)
        right = np.array([np.sin(azimuth), -np.cos(azimuth), 0.0])
        up = np.cross(right, ahead)
        gap = places - (self.target - self.distance * ahead)
        depth = gap @ ahead
        scale = focal_length(height) / np.where(np.abs(depth) < 1e-9, 1e-9, depth)
        return np.stack([width / 2 + scale * (gap @ right), height / 2 - scale * (gap @ up)], axis=-1), depth


def focal_length(height: int) -> float:
    """Pixels that 1 m takes at a depth of 1 m, in a picture so many pixels high."""
    return height / 2 / np.tan(np.radians(FIELD_OF_VIEW) / 2)


def follow(time: np.ndarray, place: Float[np.ndarray, "K 3"], smoothing: float) -> Float[np.ndarray, "K 3"]:
    """A path freed of jitter: each point the mean of its neighbours in time, weighted by a bell.

    Args:
        time: (K,) seconds.
        place: m.
        smoothing: standard deviation of the bell, s.
    """
    weight = np.exp(-0.5 * ((time[:, None] - time[None]) / smoothing) ** 2)
    return (weight / weight.sum(axis=1, keepdims=True)) @ place
