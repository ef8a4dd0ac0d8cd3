"""A world as dm_control's own `Physics`, for its viewer and its pixel wrapper.

Bodies are dressed as in films, so that a camera tells the living from the dead. What films draw on top
(trails, hazards) is left out: a hidden hazard must stay hidden from agents that see pixels.
"""

from __future__ import annotations

import mujoco
import numpy as np
from dm_control.mujoco import Physics, wrapper
from jaxtyping import Float

from hipg_bench.rendering.motion import Trajectory
from hipg_bench.rendering.scene import Scene
from hipg_bench.spec import TaskSpec

_STATE = int(mujoco.mjtState.mjSTATE_INTEGRATION)
_BURNT = 1.0
"""Seconds after which films show a wreck as burnt out; here it is so at once."""


class Mirror:
    """Shows one world's rows; the world itself is elsewhere, what is done to the mirror does not move it."""

    def __init__(self, spec: TaskSpec, row: Float[np.ndarray, "R"]) -> None:
        """Compile the world with everything a camera sees.

        Raises:
            RenderError: nobody has said how the family looks.
        """
        self._scene = Scene(Trajectory(spec, row[None]))
        self._physics = Physics(wrapper.MjData(self._scene.trajectory.data))
        self._show()

    def physics(self, row: Float[np.ndarray, "R"]) -> Physics:
        """The physics, put at ``row``: always the same object, all derived quantities computed."""
        if not np.array_equal(row, self._scene.trajectory.rows[0]):
            self._scene.trajectory.load(row[None])
            self._show()
        return self._physics

    def _show(self) -> None:
        trajectory = self._scene.trajectory
        self._scene.update(float(trajectory.time[0]) + _BURNT)
        # films interpolate, and lean drones into their thrust; here every number is the world's own
        mujoco.mj_setState(trajectory.model, trajectory.data, trajectory.rows[0], _STATE)
        mujoco.mj_forward(trajectory.model, trajectory.data)
