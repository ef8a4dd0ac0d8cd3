"""Smooth motion between saved state rows.

A row is taken at the end of each control step. Between two rows, coordinates follow the curve that
has the right values and velocities at both; what the episode remembers (health, ...) changes at the
rows only.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Mapping

import mujoco
import numpy as np
from jaxtyping import Float, Int

from hipg_bench.env import world_model
from hipg_bench.errors import RenderError
from hipg_bench.families.family import NEVER
from hipg_bench.registry import definition_of
from hipg_bench.sim import columns
from hipg_bench.spec import TaskSpec
from hipg_bench.stepper import row_type

_STATE = mujoco.mjtState
_COARSE = 0.05
"""Control steps longer than this are interpolated with velocities, s; shorter ones by straight lines."""
_LEAN_WINDOW = 0.15
"""Standard deviation of the smoothing of accelerations that drones lean into, s."""
_AFTERMATH = 0.5
"""Until a dead agent is dark and the flash of its death is over, s."""


class Trajectory:
    """Saved rows of one world, and the world itself with everything a camera sees.

    Attributes:
        spec: the task.
        definition: what its family says.
        model: compiled with visuals.
        data: the world as `show` last left it.
        rows: (K, R) of one episode, in order.
        body_position: (K, nbody, 3) where every body was at each row, m.
        time: (K,) seconds since the episode began.
        field: name to (K, *axes), what the world held at each row.
    """

    def __init__(self, spec: TaskSpec, rows: Float[np.ndarray, "K R"]) -> None:
        """Compile the world and check that the rows are of it.

        Raises:
            RenderError: rows of another task, or not finite.
        """
        self.spec = spec
        self.definition = definition_of(spec)
        self.model = world_model(self.definition, visual=True)
        self._row_type = row_type(self.definition, self.model)
        self.data = mujoco.MjData(self.model)
        self.size = mujoco.mj_stateSize(self.model, _STATE.mjSTATE_INTEGRATION)
        self._scratch = mujoco.MjData(self.model)
        self.load(rows)

    def load(self, rows: Float[np.ndarray, "K R"]) -> None:
        """Show other rows of the same task, up to where another episode begins.

        Raises:
            RenderError: rows of another task, or not finite.
        """
        if rows.ndim != 2 or rows.shape[1] != self.size or len(rows) == 0:
            raise RenderError(
                f"{self.spec.task}: rows of shape (K >= 1, {self.size}) are allowed, got {rows.shape}"
            )
        rows = rows[_first_episode(self._fields(rows))]
        if not np.isfinite(rows).all():
            raise RenderError(f"{self.spec.task}: finite rows are allowed, row {_first_bad(rows)} is not")
        self._hold(np.array(rows, np.float64), self._places(rows))

    def append(self, row: Float[np.ndarray, "R"]) -> None:
        """Add the row of the next control step; a row of another episode takes the place of all."""
        rows = np.concatenate([self.rows, row[None]])
        if len(rows[_first_episode(self._fields(rows))]) < len(rows):
            self.load(row[None])
        else:
            self._hold(rows, np.concatenate([self.body_position, self._places(row[None])]))

    def _hold(self, rows: np.ndarray, places: np.ndarray) -> None:
        """Keep rows, and forget what was derived from others."""
        self.rows, self.body_position = rows, places
        self.field = self._fields(rows)
        self.time = self.field["elapsed"] * self.spec.control_step
        for name in ("lifetime", "acceleration"):
            self.__dict__.pop(name, None)

    @property
    def num_agents(self) -> int:
        """N."""
        return self.spec.num_agents

    @functools.cached_property
    def lifetime(self) -> Float[np.ndarray, "N"]:
        """When each agent's health reached 0, s; inf for those alive in the last row.

        Where the rows begin after that, or hold a health that somebody set, the episode tells when. A single
        row shows the dead as they look some time later.
        """
        dead = self.field["health"] == 0
        seen = self.time[dead.argmax(axis=0)]
        if len(self.rows) == 1:
            seen = seen - _AFTERMATH
        died = self.field["death_time"][-1] * self.spec.control_step
        first = np.where(self.field["death_time"][-1] == NEVER, seen, np.minimum(seen, died))
        return np.where(dead.any(axis=0), first, np.inf)

    def since(self, name: str, time: float) -> Float[np.ndarray, "size"]:
        """Seconds for which each entry of a remembered flag has been up; negative while it is down."""
        up = self.field[name] > 0
        first = np.where(up.any(axis=0), self.time[up.argmax(axis=0)], np.inf)
        return np.where(time >= first, time - np.where(np.isfinite(first), first, 0.0), -1.0)

    def remembered(self, time: float) -> Mapping[str, Float[np.ndarray, "size"]]:
        """What the episode remembers at a time: that of the latest row."""
        row = self._before(time)
        return {name: value[row] for name, value in self.field.items()}

    def show(self, time: float) -> None:
        """Put ``data`` at a time between the first and the last row, kinematics computed."""
        before = self._before(time)
        after = min(before + 1, len(self.rows) - 1)
        mujoco.mj_setState(self.model, self.data, self.rows[before], _STATE.mjSTATE_INTEGRATION)
        step = self.time[after] - self.time[before]
        if step > 0:
            share = float(np.clip((time - self.time[before]) / step, 0.0, 1.0))
            self.data.qpos[:] = self._between(before, after, share, step)
            start, end = self._part("MOCAP_POS")[before], self._part("MOCAP_POS")[after]
            self.data.mocap_pos[:] = ((1 - share) * start + share * end).reshape(-1, 3)
            start, end = self._part("MOCAP_QUAT")[before], self._part("MOCAP_QUAT")[after]
            self.data.mocap_quat[:] = _turned(start.reshape(-1, 4), end.reshape(-1, 4), share)
        self.data.time = time
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_camlight(self.model, self.data)

    def _places(self, rows: np.ndarray) -> Float[np.ndarray, "K nbody 3"]:
        """Where every body is in each row, m."""
        places = np.empty((len(rows), self.model.nbody, 3))
        for place, row in zip(places, rows, strict=True):
            mujoco.mj_setState(self.model, self._scratch, row, _STATE.mjSTATE_INTEGRATION)
            mujoco.mj_kinematics(self.model, self._scratch)
            place[:] = self._scratch.xpos
        return places

    def body(self, name: str) -> int:
        """Index of a body.

        Raises:
            RenderError: the world has no such body.
        """
        index = mujoco.mj_name2id(self.model, mujoco.mjtObj.mjOBJ_BODY, name)
        if index < 0:
            raise RenderError(f"{self.spec.task}: the world has no body {name!r}")
        return index

    def path(self, body: int, start: float, end: float, points: int) -> Float[np.ndarray, "points 3"]:
        """Where a body went between two times, m; before the first row it stood still."""
        when = np.linspace(start, end, points)
        return np.stack(
            [np.interp(when, self.time, self.body_position[:, body, k]) for k in range(3)], axis=1
        )

    @functools.cached_property
    def acceleration(self) -> Float[np.ndarray, "K nbody 3"]:
        """Smoothed acceleration of every body at each row, m/s^2."""
        if len(self.rows) < 3:
            return np.zeros_like(self.body_position)
        step = float(np.median(np.diff(self.time)))
        velocity = np.gradient(self.body_position, step, axis=0)
        rate = np.gradient(velocity, step, axis=0)
        reach = max(1, round(2 * _LEAN_WINDOW / step))
        bell = np.exp(-0.5 * (np.arange(-reach, reach + 1) * step / _LEAN_WINDOW) ** 2)
        padded = np.concatenate([rate[:1].repeat(reach, 0), rate, rate[-1:].repeat(reach, 0)])
        smooth = np.zeros_like(rate)
        for k, weight in enumerate(bell / bell.sum()):
            smooth += weight * padded[k : k + len(rate)]
        return smooth

    def _before(self, time: float) -> int:
        """The latest row not after a time; a hair of slack for rounding."""
        return int(np.clip(np.searchsorted(self.time, time + 1e-9, side="right") - 1, 0, len(self.time) - 1))

    def _part(self, name: str) -> Float[np.ndarray, "K size"]:
        """Columns of the rows that hold one component of the integration state."""
        return self.rows[:, columns(self.model, name)]

    def _fields(self, rows: np.ndarray) -> dict[str, np.ndarray]:
        worlds = np.ascontiguousarray(rows, np.float64).view(self._row_type)[:, 0]
        return {name: worlds[name] for name in self._row_type.names or ()}

    def _between(self, before: int, after: int, share: float, step: float) -> Float[np.ndarray, "nq"]:
        """Generalised coordinates between two rows."""
        start, end = self._part("QPOS")[before], self._part("QPOS")[after]
        place = (1 - share) * start + share * end
        index = self._joints
        if step > _COARSE:
            rate = self._part("QVEL")
            slope, later = (rate[row, index.scalar_velocity] * step for row in (before, after))
            a, b = start[index.scalar], end[index.scalar]
            # limits are soft: rows may lie beyond them, curves must not go further
            low, high = np.minimum(index.low, np.minimum(a, b)), np.maximum(index.high, np.maximum(a, b))
            place[index.scalar] = np.clip(_hermite(a, b, slope, later, share), low, high)
        for quaternion in index.quaternion:
            place[quaternion] = _turned(start[quaternion][None], end[quaternion][None], share)[0]
        return place

    @functools.cached_property
    def _joints(self) -> _Joints:
        model, kind = self.model, mujoco.mjtJoint
        scalar = np.isin(model.jnt_type, (int(kind.mjJNT_SLIDE), int(kind.mjJNT_HINGE)))
        limited = model.jnt_limited[scalar] > 0
        starts = [
            address + (3 if joint == int(kind.mjJNT_FREE) else 0)
            for address, joint in zip(model.jnt_qposadr.tolist(), model.jnt_type.tolist(), strict=True)
            if joint in (int(kind.mjJNT_FREE), int(kind.mjJNT_BALL))
        ]
        return _Joints(
            scalar=model.jnt_qposadr[scalar],
            scalar_velocity=model.jnt_dofadr[scalar],
            low=np.where(limited, model.jnt_range[scalar, 0], -np.inf),
            high=np.where(limited, model.jnt_range[scalar, 1], np.inf),
            quaternion=tuple(slice(start, start + 4) for start in starts),
        )


@dataclasses.dataclass(frozen=True)
class _Joints:
    """Where the slides and hinges, and the quaternions, lie in the coordinates."""

    scalar: Int[np.ndarray, "n"]
    scalar_velocity: Int[np.ndarray, "n"]
    low: Float[np.ndarray, "n"]
    high: Float[np.ndarray, "n"]
    quaternion: tuple[slice, ...]


def _first_episode(field: Mapping[str, np.ndarray]) -> slice:
    """The rows up to where another episode begins."""
    elapsed, episode = field["elapsed"], field["episode_id"]
    other = (episode[1:] != episode[:-1]) | (elapsed[1:] <= elapsed[:-1])
    return slice(0, int(other.argmax()) + 1 if other.any() else len(elapsed))


def _first_bad(rows: np.ndarray) -> int:
    return int((~np.isfinite(rows)).any(axis=1).argmax())


def _hermite(
    start: np.ndarray, end: np.ndarray, start_slope: np.ndarray, end_slope: np.ndarray, share: float
) -> np.ndarray:
    """Cubic with given values and slopes (per step) at both ends."""
    s, r = share, 1.0 - share
    rise = end - start
    return r * start + s * end + s * r * (r * (start_slope - rise) - s * (end_slope - rise))


def _turned(start: np.ndarray, end: np.ndarray, share: float) -> np.ndarray:
    """Normalised mix of unit quaternions (n, 4) the short way round; steps are small."""
    end = np.where((start * end).sum(axis=-1, keepdims=True) < 0, -end, end)
    mix = (1 - share) * start + share * end
    return mix / np.maximum(np.linalg.norm(mix, axis=-1, keepdims=True), 1e-12)
