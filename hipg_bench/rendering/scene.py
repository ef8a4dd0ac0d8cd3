"""What a world looks like at one time: dressed agents, and what its family wants seen.

A stranger should see at a glance who is alive, what is dangerous and what is linked.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import mujoco

from hipg_bench.errors import RenderError, hint
from hipg_bench.rendering import drones, walkers
from hipg_bench.rendering.agents import Cast
from hipg_bench.rendering.brush import Brush, Label
from hipg_bench.rendering.camera import Camera
from hipg_bench.rendering.look import Look, Status, mark_agents
from hipg_bench.rendering.motion import Footage

LOOKS: Mapping[str, Callable[[Footage, Cast], Look]] = {
    "hazard_nav": drones.Navigation,
    "hazard_comm": drones.Communication,
    "paper_nav": drones.Navigation,
    "paper_comm": drones.Communication,
    "multiwalker": walkers.Carrying,
}
"""Family to how it is shown."""


class Stage:
    """One world, ready to be drawn at any time of its footage.

    Attributes:
        footage: its rows.
        cast: its agents.
        legend: what the colours mean, one line.
        travels: whether the team leaves the place where it began.
    """

    def __init__(self, footage: Footage) -> None:
        """Prepare the agents and the family's look.

        Raises:
            RenderError: nobody has said how the family looks.
        """
        family = footage.spec.family
        if family not in LOOKS:
            raise RenderError(f"{footage.spec.task}: no look for family {family!r}{hint(family, LOOKS)}")
        self.footage = footage
        self.cast = Cast(footage)
        self._look = LOOKS[family](footage, self.cast)
        self.legend = self._look.legend
        self.travels = self._look.travels
        # shadows are computed within a square around the camera's target
        footage.model.vis.map.shadowclip = self._look.reach / footage.model.stat.extent

    def dress(self, time: float) -> None:
        """Put the model's data at a time, agents coloured."""
        self.footage.show(time)
        self.cast.dress(time)
        self._look.dress(time)

    def decorate(
        self, scene: mujoco.MjvScene, time: float, height: int = 720
    ) -> tuple[list[Label], list[Status]]:
        """Add to a scene what is in no model, for so many pixels; return what to write on the picture."""
        brush = Brush(scene, self.camera(time), height)
        mark_agents(brush, self._look, self.cast, self.footage, time)
        return brush.labels, self._look.decorate(brush, time)

    def camera(self, time: float) -> Camera:
        """The view at a time."""
        return self._look.camera(time)
