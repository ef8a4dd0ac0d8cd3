"""Drones in a box: the body, flight and senses that the 3D point-mass families share."""

from __future__ import annotations

import functools

import mujoco
import numpy as np
import pydantic
from jaxtyping import Float, Int

from hipg_bench.families.family import EVERY, Rows
from hipg_bench.families.scene import asset, attach
from hipg_bench.layout import Block, Layout
from hipg_bench.mechanics import coverage, sensing
from hipg_bench.sim import Sim
from hipg_bench.spec import Params, TaskSpec

_PHYSICS_STEP = 0.02
"""Seconds per physics step."""

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
) -> tuple[Float[np.ndarray, "n N 3"], Float[np.ndarray, "n N 3"]]:
    """Copies of the drones' positions (m) and velocities (m/s)."""
    position = sim.position[rows].reshape(-1, num_agents, 3)
    velocity = sim.velocity[rows].reshape(-1, num_agents, 3)
    return position.copy(), velocity.copy()


def spread(
    chance: Float[np.ndarray, "n C P 3"], low: tuple[float, float, float], high: tuple[float, float, float]
) -> Float[np.ndarray, "n P 3"]:
    """Of C candidate placements in a box, the one whose nearest pair is farthest apart."""
    place = np.asarray(low) + chance * (np.asarray(high) - np.asarray(low))
    n, c, p, _ = place.shape
    gap = coverage.distances(place.reshape(n * c, p, 3), place.reshape(n * c, p, 3))
    gap = np.where(np.eye(p, dtype=bool), np.inf, gap).min(axis=(1, 2)).reshape(n, c)
    return place[np.arange(n), gap.argmax(axis=1)]


def neighbor_blocks(slots: int, visible: str) -> tuple[Block, ...]:
    """Observation blocks filled by `neighbors`."""
    return (
        Block("neighbor_seen", (slots,), "1", "-", visible),
        Block("neighbor_health", (slots,), "1", "-", visible),
        Block("neighbor_position", (slots, 3), "m", "own", visible),
        Block("neighbor_velocity", (slots, 3), "m/s", "own", visible),
    )


@functools.cache
def _others(num_agents: int) -> np.ndarray:
    """(1, N, N) True off the diagonal."""
    return ~np.eye(num_agents, dtype=bool)[None]


def neighbors(
    apart: Float[np.ndarray, "n N N"],
    position: Float[np.ndarray, "n N 3"],
    velocity: Float[np.ndarray, "n N 3"],
    health: Float[np.ndarray, "n N"],
    radius: float,
    slots: int,
    *,
    live_only: bool = False,
) -> dict[str, np.ndarray]:
    """What each drone senses of the nearest other drones, dead ones included unless ``live_only``.

    Returns:
        The blocks of `neighbor_blocks`.
    """
    visible = _others(position.shape[1])
    if live_only:
        visible = visible & (health > 0)[:, None, :]
    sensed = sensing.nearest_within(apart, visible, radius, slots)
    of = np.concatenate([position, velocity, health[..., None]], axis=-1)
    own = np.concatenate([position, velocity, np.zeros_like(health)[..., None]], axis=-1)
    found = np.where(sensed.seen[..., None], sensing.gather(of, sensed) - own[:, :, None], 0.0)
    return {
        "neighbor_seen": sensed.seen,
        "neighbor_health": found[..., 6],
        "neighbor_position": found[..., 0:3],
        "neighbor_velocity": found[..., 3:6],
    }
