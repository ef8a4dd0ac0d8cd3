"""Drones in a box: the body, flight and senses that the 3D point-mass families share."""

from __future__ import annotations

import math
from typing import Any

import mujoco
import numpy as np
import pydantic
from jaxtyping import Float, Int

from hipg_bench.families import family
from hipg_bench.families.scene import asset, attach
from hipg_bench.layout import SHARE, Block, Layout
from hipg_bench.mechanics.geometry import distance3
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


class World(family.World):
    """What every world with drones has."""

    position: Float[np.ndarray, "N 3"]  # m
    velocity: Float[np.ndarray, "N 3"]  # m/s
    control: Float[np.ndarray, "N 3"]  # of full thrust


class Scratch(family.Scratch):
    """What a step works out of where drones are."""

    apart: Float[np.ndarray, "N N"]  # drone to drone, infinite to oneself, m
    order: Int[np.ndarray, "most"]  # of drones or points, nearest first
    away: Float[np.ndarray, "most"]  # m


class Numbers(family.Numbers):
    """Numbers of drones; see `DroneParams`."""

    half_width: float
    ceiling: float
    drone_radius: float
    sensing_radius: float


# --- rules ---------------------------------------------------------------------------------------------


def act(
    w: World, previous: family.Previous, scratch: Scratch, task: Numbers, command: Float[np.ndarray, "N 3"]
) -> None:
    """Thrust along the world's axes."""
    for i in range(len(w.health)):
        for axis in range(3):
            w.control[i, axis] = command[i, axis]


def find_neighbors(w: World, scratch: Scratch) -> None:
    """Work out how far drones are from each other."""
    position, apart = w.position, scratch.apart
    for i in range(len(position)):
        apart[i, i] = math.inf
        for j in range(i):
            apart[i, j] = apart[j, i] = distance3(position[j], position[i])


def observe_self(w: World, i: int, seen: Any) -> None:
    """Write a drone's own health, velocity and position."""
    seen.health[0] = w.health[i]
    for axis in range(3):
        seen.velocity[axis], seen.position[axis] = w.velocity[i, axis], w.position[i, axis]


def clear_neighbor(seen: Any, slot: int) -> None:
    """Empty a neighbour's slot."""
    seen.neighbor_seen[slot], seen.neighbor_health[slot] = 0.0, 0.0
    for axis in range(3):
        seen.neighbor_position[slot, axis], seen.neighbor_velocity[slot, axis] = 0.0, 0.0


def observe_neighbor(w: World, i: int, j: int, seen: Any, slot: int) -> None:
    """Write drone j into a neighbour's slot of drone i."""
    seen.neighbor_seen[slot], seen.neighbor_health[slot] = 1.0, w.health[j]
    for axis in range(3):
        seen.neighbor_position[slot, axis] = w.position[j, axis] - w.position[i, axis]
        seen.neighbor_velocity[slot, axis] = w.velocity[j, axis] - w.velocity[i, axis]


def describe(w: World, state: Any) -> None:
    """Write all drones into the joint state."""
    for i in range(len(w.health)):
        state.health[i] = w.health[i]
        for axis in range(3):
            state.position[i, axis], state.velocity[i, axis] = w.position[i, axis], w.velocity[i, axis]


# --- declarations --------------------------------------------------------------------------------------


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


def neighbor_blocks(slots: int, visible: str) -> tuple[Block, ...]:
    """Observation blocks of the nearest other drones."""
    return (
        Block("neighbor_seen", (slots,), "1", "-", visible, limits=SHARE),
        Block("neighbor_health", (slots,), "1", "-", visible, limits=SHARE),
        Block("neighbor_position", (slots, 3), "m", "own", visible),
        Block("neighbor_velocity", (slots, 3), "m/s", "own", visible),
    )


def numbers(params: DroneParams, names: type) -> dict[str, Any]:
    """The numbers of a task that a record of numbers names."""
    return {name: value for name, value in params.model_dump().items() if name in names.__annotations__}
