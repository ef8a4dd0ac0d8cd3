"""Drones in a box: the body, flight and senses that the 3D point-mass families share."""

from __future__ import annotations

from collections.abc import Mapping

import mujoco
import numpy as np
import pydantic
from jaxtyping import Bool, Float, Int

from hipg_bench.families.family import EVERY, Rows
from hipg_bench.families.scene import asset, attach
from hipg_bench.layout import SHARE, Block, Layout
from hipg_bench.mechanics import coverage
from hipg_bench.sim import Sim
from hipg_bench.spec import Params, TaskSpec

_PHYSICS_STEP = 0.02
"""Seconds per physics step."""

_COLUMNS = 32
"""Columns of an observation that are turned together, from worlds last to worlds first."""

ACTION = Layout((Block("thrust", (3,), "of full thrust", "world"),))


class DroneParams(Params):
    """Numbers of a drone and of the box it flies in.

    Attributes:
        half_width: the box is [-half_width, half_width]^2 x [0, ceiling], m.
        ceiling: m.
        drone_radius: of the collision sphere, m.
        thrust: full force along each axis, N, for a mass of 1 kg.
        drag: N s/m; top speed is thrust / drag.
        sensing_radius: how far a drone senses other drones, m.
        neighbors: how many of them at most (fewer in a small team).
    """

    half_width: float = pydantic.Field(gt=0, le=10)
    ceiling: float = pydantic.Field(gt=0.2, le=10)
    drone_radius: float = pydantic.Field(gt=0, le=0.2)
    thrust: float = pydantic.Field(gt=0, le=100)
    drag: float = pydantic.Field(gt=0, le=100)
    sensing_radius: float = pydantic.Field(gt=0, le=20)
    neighbors: int = pydantic.Field(ge=1, le=30)


def physics_steps(spec: TaskSpec) -> int:
    """Physics steps per control step."""
    return max(1, round(spec.control_step / _PHYSICS_STEP))


def drone_scene(spec: TaskSpec, params: DroneParams) -> mujoco.MjSpec:
    """An arena with N drones; drone i's joints, sphere and motors are prefixed ``drone<i>/``."""
    scene = asset("arena.xml")
    scene.option.timestep = spec.control_step / physics_steps(spec)
    for i in range(spec.num_agents):
        drone = asset("drone.xml")
        reach = params.half_width + 0.1
        for name, limits in (
            ("x", (-reach, reach)),
            ("y", (-reach, reach)),
            ("z", (params.drone_radius, params.ceiling)),
        ):
            joint = drone.joint(name)
            joint.range = np.array(limits)
            joint.damping[0] = params.drag  # the other entries are higher powers of speed
        drone.geom("hull").size[0] = params.drone_radius
        for motor in drone.actuators:
            motor.group = i
            motor.gainprm[0] = params.thrust
        # lift is the bias of the drone's own motor: a dead drone falls
        drone.actuator("z").biasprm[0] = -scene.option.gravity[2]
        attach(scene, drone, f"drone{i}/")
    return scene


def place(sim: Sim, ids: Int[np.ndarray, "n"], position: Float[np.ndarray, "n N 3"]) -> None:
    """Put drones at rest at the given places, m."""
    sim.position[ids] = position.reshape(len(ids), -1)


def kinematics(
    sim: Sim, num_agents: int, rows: Rows = EVERY
) -> tuple[Float[np.ndarray, "3 N n"], Float[np.ndarray, "3 N n"]]:
    """Copies of the drones' positions (m) and velocities (m/s), worlds last."""
    position = sim.position[rows].reshape(-1, num_agents, 3)
    velocity = sim.velocity[rows].reshape(-1, num_agents, 3)
    return position.T.copy(), velocity.T.copy()


def living(health: Float[np.ndarray, "n N"]) -> Bool[np.ndarray, "N n"]:
    """Who lives, worlds last."""
    return health.T.copy() > 0


def replace(now: object, ids: Int[np.ndarray, "n"], fresh: object) -> None:
    """Replace some worlds of a snapshot, in which all arrays but health have the worlds last."""
    for name, array in vars(now).items():
        if isinstance(array, np.ndarray) and hasattr(fresh, name):
            array[ids if name == "health" else (..., ids)] = getattr(fresh, name)


def spread(
    chance: Float[np.ndarray, "n C P 3"], low: tuple[float, float, float], high: tuple[float, float, float]
) -> Float[np.ndarray, "n P 3"]:
    """Of C candidate placements in a box, the one whose nearest pair is farthest apart."""
    place = np.asarray(low) + chance * (np.asarray(high) - np.asarray(low))
    n, c, p, _ = place.shape
    gap = coverage.apart(place.reshape(n * c, p, 3).T).min(axis=(0, 1)).reshape(n, c)
    return place[np.arange(n), gap.argmax(axis=1)]


def neighbor_blocks(slots: int, visible: str) -> tuple[Block, ...]:
    """Observation blocks filled by `sensing.write_team`."""
    return (
        Block("neighbor_seen", (slots,), "1", "-", visible, limits=SHARE),
        Block("neighbor_health", (slots,), "1", "-", visible, limits=SHARE),
        Block("neighbor_position", (slots, 3), "m", "own", visible),
        Block("neighbor_velocity", (slots, 3), "m/s", "own", visible),
    )


def pack(
    layout: Layout, parts: Mapping[str, np.ndarray], lead: tuple[int, ...]
) -> Float[np.ndarray, "n *lead size"]:
    """As `Layout.pack`, from parts of shape ``(*block.shape, *lead, n)``: worlds last.

    Args:
        layout: of observations, or of the joint state.
        parts: one array per block.
        lead: n, and N for observations.

    Raises:
        ValueError: the names are not exactly those of the blocks.
    """
    if parts.keys() != layout.slices.keys():
        raise ValueError(f"parts {sorted(parts)} do not match the blocks {sorted(layout.slices)}")
    worlds, *agents = lead
    # a little longer than the worlds: rows a power of two apart evict each other from the cache
    flat = np.empty((layout.size, *agents, worlds + 16), np.float32)[..., :worlds]
    for block in layout.blocks:
        rows = flat[layout.slices[block.name]]
        rows.reshape(*block.shape, *rows.shape[1:], copy=False)[...] = parts[block.name]
    packed = np.empty((*lead, layout.size), np.float32)
    # and so do too many of them
    for start in range(0, layout.size, _COLUMNS):
        packed[..., start : start + _COLUMNS] = flat[start : start + _COLUMNS].T
    return packed
