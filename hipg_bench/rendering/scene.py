"""What a world looks like at one time: dressed agents, and what its family wants seen.

A stranger should see at a glance who is alive, what is dangerous and what is linked.
"""

from __future__ import annotations

from collections.abc import Callable

import mujoco

from hipg_bench.errors import RenderError
from hipg_bench.families.known import declared
from hipg_bench.rendering.agents import AgentVisuals
from hipg_bench.rendering.camera import Camera
from hipg_bench.rendering.look import Look, Status, mark_agents
from hipg_bench.rendering.motion import Trajectory
from hipg_bench.rendering.painter import Label, Painter


class Scene:
    """One world, ready to be drawn at any time of its trajectory.

    Attributes:
        trajectory: its rows.
        visuals: its agents.
        legend: what the colours mean, one line.
        travels: whether the team leaves the place where it began.
    """

    def __init__(self, trajectory: Trajectory) -> None:
        """Prepare the agents and the family's look.

        Raises:
            RenderError: nobody has said how the family looks.
        """
        family = trajectory.spec.family
        style: Callable[[Trajectory, AgentVisuals], Look] | None = declared(family, "RENDERING")
        if style is None:
            raise RenderError(f"{trajectory.spec.task}: family {family!r} declares no RENDERING")
        self.trajectory = trajectory
        self.visuals = AgentVisuals(trajectory)
        self._look = style(trajectory, self.visuals)
        self.legend = self._look.legend
        self.travels = self._look.travels
        # shadows are computed within a square around the camera's target
        trajectory.model.vis.map.shadowclip = self._look.reach / trajectory.model.stat.extent

    def update(self, time: float) -> None:
        """Put the model's data at a time, agents coloured."""
        self.trajectory.show(time)
        self.visuals.update(time)
        self._look.update(time)

    def decorate(
        self, mjv_scene: mujoco.MjvScene, time: float, height: int = 720
    ) -> tuple[list[Label], list[Status]]:
        """Add to a scene what is in no model, for so many pixels; return what to write on the picture."""
        painter = Painter(mjv_scene, self.camera(time), height)
        mark_agents(painter, self._look, self.visuals, self.trajectory, time)
        return painter.labels, self._look.decorate(painter, time)

    def camera(self, time: float) -> Camera:
        """The view at a time."""
        return self._look.camera(time)
