"""What agents look like: a hue each, drones that lean into their thrust, wrecks that burn out.

Drones are point masses. That they lean, and that rotors turn, is for the eye only: drawn geoms are
turned, nothing else.
"""

from __future__ import annotations

import re

import mujoco
import numpy as np
from jaxtyping import Float

from hipg_bench.families.scene import VISUAL_GROUP
from hipg_bench.rendering import palette
from hipg_bench.rendering.motion import Trajectory

_AGENT = re.compile(r"(?:drone|walker|particle)(\d+)/")
"""How names of an agent's parts begin."""
_TINTED = ("paint", "signal", "skin")
"""Materials that take the agent's hue; the others keep their own colour."""
_TINTED_PARTS = ("shell", "cap")
"""The same for parts without material."""
_SHINE = 0.2
"""Least emission of those materials: who is who must be seen in the shade, too."""

_GRAVITY = 9.81
_STEEPEST = 0.45
"""Largest lean, rad."""
_SPIN = 41.0
"""Turning of rotor blades, rad/s; at 30 frames/s it looks fast and does not look frozen."""
_FADE = 0.35
"""Seconds from a death until the wreck is dark."""


class AgentVisuals:
    """The agents of a world, to be dressed for a time.

    Attributes:
        colour: (N, 3) hue of each agent.
        root: (N,) body that stands for each agent.
    """

    def __init__(self, trajectory: Trajectory) -> None:
        self._trajectory = trajectory
        self._model = trajectory.model
        self.colour = palette.team(trajectory.num_agents)
        owner = [_owner(self._model, mujoco.mjtObj.mjOBJ_BODY, k) for k in range(self._model.nbody)]
        self.root = np.array([owner.index(i) for i in range(trajectory.num_agents)])
        self._geoms = [
            np.flatnonzero([owner[b] == i for b in self._model.geom_bodyid])
            for i in range(trajectory.num_agents)
        ]
        self._rgba = _resting_colour(self._model)
        tinted = np.array(
            [_material(self._model, k).endswith(_TINTED) for k in range(self._model.nmat)], bool
        )
        self._emission = np.where(
            tinted, np.maximum(self._model.mat_emission, _SHINE), self._model.mat_emission
        )
        names = [self._model.geom(k).name.rpartition("/")[2] for k in range(self._model.ngeom)]
        self._tinted = (self._model.geom_matid >= 0) & tinted[self._model.geom_matid]
        self._tinted |= np.isin(names, _TINTED_PARTS)
        self._blade = np.array([name.startswith("blade") for name in names])
        self._rotor = np.array([name.startswith("rotor") for name in names])
        self._flies = bool(self._blade.any())

    def place(self, agent: int) -> Float[np.ndarray, "3"]:
        """Where an agent is now, m."""
        return self._trajectory.data.xpos[self.root[agent]].copy()

    @property
    def middle(self) -> Float[np.ndarray, "3"]:
        """Of the team, m."""
        return self._trajectory.data.xpos[self.root].mean(axis=0)

    def update(self, time: float) -> None:
        """Colour the agents, and lean the drones, as of the time that the trajectory shows."""
        for agent in range(self._trajectory.num_agents):
            dead_for = time - float(self._trajectory.lifetime[agent])
            self._paint(agent, dead_for)
            if self._flies:
                self._lean(agent, time, dead_for)

    def _paint(self, agent: int, dead_for: float) -> None:
        geoms = self._geoms[agent]
        rgba = self._rgba[geoms]
        tinted = self._tinted[geoms]
        # what glows is also lit: keep the sum within range, or hues wash out
        glow = np.where(
            self._model.geom_matid[geoms] >= 0, self._emission[self._model.geom_matid[geoms]], 0.0
        )
        rgba[tinted, :3] = self.colour[agent] / (1.0 + 0.9 * glow[tinted, None])
        burnt = float(np.clip(dead_for / _FADE, 0.0, 1.0))
        rgba[:, :3] = (1 - burnt) * rgba[:, :3] + burnt * np.asarray(palette.WRECK)
        rgba[self._rotor[geoms], 3] *= 1 - burnt
        self._model.geom_rgba[geoms] = rgba
        material = self._model.geom_matid[geoms]
        material = material[material >= 0]
        self._model.mat_emission[material] = (1 - burnt) * self._emission[material]

    def _lean(self, agent: int, time: float, dead_for: float) -> None:
        """Turn what is drawn of a drone about its centre; wrecks tumble and settle on the floor."""
        data, model = self._trajectory.data, self._model
        geoms = self._geoms[agent]
        geoms = geoms[model.geom_group[geoms] == VISUAL_GROUP]
        centre = data.xpos[self.root[agent]]
        turn = self._attitude(agent, time) if dead_for < 0 else _tumble(agent, dead_for)
        sink = 0.0
        if dead_for >= 0:
            # the hull is a ball; what is drawn is flat and must not hover above the floor
            hull = model.geom_size[self._geoms[agent][0], 0]
            height = (centre[2] - hull) / 0.25
            sink = max(0.0, hull - 0.016) * float(np.clip(1 - height, 0, 1)) * min(1.0, dead_for / _FADE)
        arm = data.geom_xpos[geoms] - centre
        data.geom_xpos[geoms] = centre + arm @ turn.T - np.array([0.0, 0.0, sink])
        frame = turn @ data.geom_xmat[geoms].reshape(-1, 3, 3)
        blades = self._blade[geoms]
        running = max(0.0, 1 - max(0.0, dead_for) / _FADE)
        angle = _SPIN * (time if dead_for < 0 else time - dead_for + 0.5 * _FADE * (1 - running**2))
        frame[blades] = frame[blades] @ _about_z(angle + agent)
        data.geom_xmat[geoms] = frame.reshape(-1, 9)

    def _attitude(self, agent: int, time: float) -> Float[np.ndarray, "3 3"]:
        """The lean of a real quadcopter with this acceleration and this drag."""
        trajectory = self._trajectory
        body = self.root[agent]
        push = np.array(
            [np.interp(time, trajectory.time, trajectory.acceleration[:, body, k]) for k in range(2)]
        )
        first = trajectory.model.body_dofadr[body]
        push += trajectory.data.qvel[first : first + 2] * trajectory.model.dof_damping[first]
        angle = min(_STEEPEST, float(np.arctan2(np.linalg.norm(push), _GRAVITY)))
        return _tilt(push, angle)


def _owner(model: mujoco.MjModel, kind: mujoco.mjtObj, index: int) -> int:
    """Agent that a part belongs to; -1 for none."""
    found = _AGENT.match(mujoco.mj_id2name(model, int(kind), index) or "")
    return int(found.group(1)) if found else -1


def _material(model: mujoco.MjModel, index: int) -> str:
    return mujoco.mj_id2name(model, int(mujoco.mjtObj.mjOBJ_MATERIAL), index) or ""


def _resting_colour(model: mujoco.MjModel) -> Float[np.ndarray, "ngeom 4"]:
    """A material's colour, unless the geom has its own; white counts as none."""
    rgba = model.geom_rgba.copy()
    unset = (rgba[:, :3] == 0.5).all(axis=1) | (rgba == 1.0).all(axis=1)
    from_material = unset & (model.geom_matid >= 0)
    rgba[from_material] = model.mat_rgba[model.geom_matid[from_material]]
    return rgba


def _about_z(angle: float) -> Float[np.ndarray, "3 3"]:
    cos, sin = np.cos(angle), np.sin(angle)
    return np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])


def _tilt(towards: np.ndarray, angle: float) -> Float[np.ndarray, "3 3"]:
    """Rotation that tips the vertical towards a horizontal direction (2,) by an angle, rad."""
    size = float(np.linalg.norm(towards))
    if size < 1e-9:
        return np.eye(3)
    axis = np.array([-towards[1], towards[0], 0.0]) / size
    quaternion, matrix = np.empty(4), np.empty(9)
    mujoco.mju_axisAngle2Quat(quaternion, axis, angle)
    mujoco.mju_quat2Mat(matrix, quaternion)
    return matrix.reshape(3, 3)


def _tumble(agent: int, dead_for: float) -> Float[np.ndarray, "3 3"]:
    """Attitude of a falling wreck: it tips over to one side of its own, and turns while it falls."""
    side = 2.4 * agent + 0.7
    share = min(1.0, dead_for / 0.5)
    return _tilt(np.array([np.cos(side), np.sin(side)]), 0.42 * share) @ _about_z(3.0 * share * (2 - share))
