"""Watch a team in dm_control's viewer: space starts it, backspace begins again, [ and ] change the camera.

The policy reads observations by name. It flies to the point farthest from other drones among those not known
to kill, so it learns of a hazard the hard way.
"""

import dm_env
import numpy as np
from dm_control import viewer

import hipg_bench
from hipg_bench.errors import RenderError
from hipg_bench.rendering.viewer import check_display


def policy(time_step: dm_env.TimeStep) -> list[np.ndarray]:
    """One action per agent; what dead agents are told is ignored."""
    return [fly(seen) for seen in time_step.observation]


def fly(seen: dict[str, np.ndarray]) -> np.ndarray:
    """Thrust towards a point, damped by the velocity."""
    appeal = np.where(seen["point_hazardous"] == 1, -1.0, seen["point_gap"])
    goal = seen["point_position"][appeal.argmax()]
    return np.clip(3.0 * goal - seen["velocity"], -1.0, 1.0)


if __name__ == "__main__":
    try:
        check_display()
    except RenderError as error:
        raise SystemExit(str(error)) from None
    viewer.launch(hipg_bench.load("hazard_nav", "4", task_kwargs={"random": 0}), policy)
