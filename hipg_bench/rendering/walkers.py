"""How walkers under a plank are shown: marks along the way, and the way that the plank came."""

from __future__ import annotations

import numpy as np

from hipg_bench.rendering import palette
from hipg_bench.rendering.agents import AgentVisuals
from hipg_bench.rendering.camera import FIELD_OF_VIEW, Camera, follow
from hipg_bench.rendering.look import WHITE, Status
from hipg_bench.rendering.motion import Trajectory
from hipg_bench.rendering.painter import Painter

_SMOOTHING = 0.6
"""Of the camera's way, s."""
_LANE = 1.05
"""The plank's progress is drawn this far beside it, m."""


class Carrying:
    """Marks every metre, a line as long as the plank's way, a camera that walks along."""

    legend = "carry the plank forward  ·  who falls stays down"
    body_size = 0.16
    travels = True

    def __init__(self, trajectory: Trajectory, visuals: AgentVisuals) -> None:
        self._trajectory = trajectory
        self._visuals = visuals
        self.reach = 0.6 * trajectory.num_agents + 3.0
        self._plank = trajectory.body("plank/plank")
        self._rows = self._smooth = np.empty((0, 3))

    def update(self, time: float) -> None:
        """Walkers need no more than their hues."""

    def label_place(self, agent: int) -> np.ndarray:
        """On the floor before the feet: the plank hides what is above."""
        x, y, _ = self._visuals.place(agent)
        return np.array([x, y - 0.45, 0.0])

    def decorate(self, painter: Painter, time: float) -> list[Status]:
        """Draw the marks and the plank's way."""
        place = self._trajectory.data.xpos[self._plank].copy()
        gone = float(place[0] - self._start[0])
        for mark in range(int(np.floor(gone)) - 5, int(np.ceil(gone)) + 9):
            self._draw_mark(painter, mark)
        ahead = np.array([place[0], -_LANE, 0.02])
        painter.line((self._start[0], -_LANE, 0.01), ahead, 0.012, palette.LINK, 0.85)
        painter.ball(ahead, 0.035, palette.LINK)
        painter.dashes(ahead, (place[0], -0.3, place[2]), 0.004, palette.LINK, 0.35)
        up = int((self._trajectory.remembered(time)["health"] > 0).sum())
        return [
            Status(f"plank {gone:+.2f} m", palette.LINK),
            Status(f"{up} of {self._trajectory.num_agents} on their feet", WHITE),
        ]

    def camera(self, time: float) -> Camera:
        """Beside the plank and a little ahead of it, without its jitter."""
        x, y = (float(np.interp(time, self._trajectory.time, self._way[:, axis])) for axis in (0, 1))
        reach = 0.6 * self._trajectory.num_agents + 0.55
        distance = 0.63 * reach / np.tan(np.radians(FIELD_OF_VIEW) / 2)
        return Camera(np.array([x + 0.15, 0.6 * y, 0.50]), distance, 74.0, -14.0)

    @property
    def _start(self) -> np.ndarray:
        """Where the plank was when the episode began, m."""
        gone = np.array([float(self._trajectory.field["displacement"][0]), 0.0, 0.0])
        return self._trajectory.body_position[0, self._plank] - gone

    @property
    def _way(self) -> np.ndarray:
        """The plank's way (K, 3) without its jitter, recomputed when the trajectory has changed."""
        trajectory = self._trajectory
        if self._rows is not trajectory.rows:
            self._smooth = follow(trajectory.time, trajectory.body_position[:, self._plank], _SMOOTHING)
            self._rows = trajectory.rows
        return self._smooth

    def _draw_mark(self, painter: Painter, mark: int) -> None:
        x, strong = float(self._start[0]) + mark, mark % 5 == 0
        colour = WHITE if strong else palette.IDLE
        half = (0.012 if strong else 0.006, 1.3, 0.0008)
        painter.box((x, 0.0, 0.001), half, colour, 0.55 if strong else 0.30, glow=0.5)
        painter.write((x, -1.42, 0.0), "start" if mark == 0 else f"{mark} m", colour)
