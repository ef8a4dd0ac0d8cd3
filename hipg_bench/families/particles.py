"""Particles in a plane: body, physics, contacts, senses and deaths that the paper's tasks share.

The numbers and laws are those of the authors' code, see ``docs/tasks/paper_suite.md``. One control step is
one physics step: v <- (1 - damping) v + F dt, then x <- x + v dt. MuJoCo's Euler integrator, which
treats joint damping D implicitly, does exactly this for a mass of 1 kg when 1 + dt D = 1 / (1 - damping)
and every force is multiplied by that same factor: v' = (v + dt factor F) / (1 + dt D).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

import mujoco
import numpy as np
import pydantic
from jaxtyping import Bool, Float, Int, Int32

from hipg_bench.families import family
from hipg_bench.families.family import Previous
from hipg_bench.families.scene import add_marker, asset, attach
from hipg_bench.layout import SHARE, Block, Layout
from hipg_bench.mechanics import plane
from hipg_bench.mechanics.hazards import hazard_rate, risk
from hipg_bench.mechanics.plane import (
    count_around,
    find_contacts,
    length,
    list_nearest,
    push_apart,
    write_counts,
)
from hipg_bench.spec import Params, TaskSpec

ACTION = Layout((Block("force", (2,), "N", "world"),))
PHYSICS = {
    "QPOS": ("position",), "QVEL": ("velocity",), "CTRL": ("control",), "QFRC_APPLIED": ("contact_force",),
    "MOCAP_POS": ("point",),
}  # fmt: skip
CAUSES = ("hazard", "collision")
HAZARD, COLLISION = 0, 1
LISTED = 5
"""Dead agents that a histogram observation lists."""
HEIGHT = 0.03
"""Of points above the floor, so that a camera sees them; the rules know no height, m."""
AGENT, POINT, HIDDEN = 0, plane.CELLS, 2 * plane.CELLS
"""Where the cells of a kind of things begin; the hidden are not counted."""
_CELLS = (plane.RINGS, plane.SECTORS)
IN_RANGE = f"within {plane.EDGES[-1]:g} m"


class ParticleParams(Params):
    """Numbers of a particle and its plane.

    Attributes:
        half_width: agents start in [-half_width, half_width]^2, m; the plane has no walls.
        damping: share of the speed that is lost per control step.
        contact_stiffness: of live agents that overlap, N/m.
        contact_margin: depth over which a contact sets in, m.
        collision_risk: chance that a live agent dies per step of contact with another.
        hazard_radius: beyond it a hazard is harmless, m.
        hazard_peak: chance of death per 0.1 s at its centre.
        observation: ``direct`` (every landmark and agent) or ``histogram`` (of fixed size, two steps).
    """

    half_width: float = pydantic.Field(gt=0, le=10)
    damping: float = pydantic.Field(ge=0, lt=1)
    contact_stiffness: float = pydantic.Field(ge=0, le=1000)
    contact_margin: float = pydantic.Field(gt=0, le=0.1)
    collision_risk: float = pydantic.Field(ge=0, lt=1)
    hazard_radius: float = pydantic.Field(gt=0, le=5)
    hazard_peak: float = pydantic.Field(ge=0, lt=1)
    observation: Literal["direct", "histogram"]


class World(family.World):
    """What every world with particles has."""

    position: Float[np.ndarray, "N 2"]  # m
    velocity: Float[np.ndarray, "N 2"]  # m/s; the dead stand still
    control: Float[np.ndarray, "N 2"]  # N
    contact_force: Float[np.ndarray, "N 2"]  # N
    point: Float[np.ndarray, "L 3"]  # landmarks, or terminals and the hazard, m
    seen_velocity: Float[np.ndarray, "N 2"]  # as others see it: of the dead, the one they died with, m/s
    past_position: Float[np.ndarray, "H 2"]  # at the step before, H = N where it is observed again, else 0
    past_velocity: Float[np.ndarray, "H 2"]
    past_health: Float[np.ndarray, "H"]


class Scratch(family.Scratch):
    """What a step works out; things are agents, then the points that are counted."""

    x: Float[np.ndarray, "things"]  # m
    y: Float[np.ndarray, "things"]
    kind: Int32[np.ndarray, "things"]  # where the cells of its kind begin
    cell: Int32[np.ndarray, "things"]
    count: Int32[np.ndarray, "cells"]
    dead: Bool[np.ndarray, "N"]
    deaths: bool  # whether anybody is dead
    contact: Int[np.ndarray, "pairs 2"]  # agents that overlap
    contacts: int
    both_live: float  # how many of these pairs
    one_lives: float


class Numbers(family.Numbers):
    """Numbers of particles; see `ParticleParams`."""

    half_width: float
    contact_stiffness: float
    contact_margin: float
    collision_risk: float
    hazard_radius: float
    hazard_peak: float
    direct: bool
    radius: float  # of an agent, m
    factor: float  # by which implicit damping divides, so that forces are multiplied by it


class Metrics(family.Metrics):
    """Of an episode."""

    deaths_hazard: float  # agents that a hazard killed
    deaths_collision: float  # agents that a collision killed


# --- rules ---------------------------------------------------------------------------------------------


def scatter(w: World, task: Numbers, random: Float[np.ndarray, "C"]) -> None:
    """Put agents at rest, independently and uniformly; they may overlap."""
    for i in range(len(w.health)):
        for axis in range(2):
            w.position[i, axis] = task.half_width * (2 * random[2 * i + axis] - 1)


def act(
    w: World, previous: Previous, scratch: Scratch, task: Numbers, command: Float[np.ndarray, "N 2"]
) -> None:
    """Push the living, by own force and by contact; the dead stand still at once and touch nobody."""
    for i in range(len(w.past_health)):
        w.past_health[i] = w.health[i]
        for axis in range(2):
            w.past_position[i, axis], w.past_velocity[i, axis] = w.position[i, axis], moves(w, i, axis)
    for i in range(len(w.health)):
        for axis in range(2):
            w.control[i, axis] = command[i, axis]
            if w.health[i] == 0:
                w.velocity[i, axis] = 0.0
    push_apart(
        w.position, w.health, 2 * task.radius, task.contact_stiffness, task.contact_margin, task.factor,
        w.contact_force,
    )  # fmt: skip


def moves(w: World, i: int, axis: int) -> float:
    """An agent's velocity as others see it, m/s."""
    return w.velocity[i, axis] if w.health[i] > 0 else w.seen_velocity[i, axis]


def read(w: World, scratch: Scratch, task: Numbers) -> None:
    """Find who overlaps. Positions do not lag behind the physics: they are generalised coordinates."""
    scratch.contacts = find_contacts(w.position, 2 * task.radius, scratch.contact)


def burn(w: World, task: Numbers, i: int, p: int) -> float:
    """Hazard that an agent gains from a point that harms, nats; negative where it is out of reach."""
    away = length(w.point[p, 0] - w.position[i, 0], w.point[p, 1] - w.position[i, 1])
    if away >= task.hazard_radius:
        return -1.0
    return hazard_rate(risk(away, task.hazard_radius, task.hazard_peak), task.reference_steps)


def crash(w: World, scratch: Scratch, task: Numbers, i: int) -> None:
    """Add the hazard of an agent's contacts with other live agents, and say what harmed it more."""
    touching, harmed = 0.0, scratch.harm[i]
    for k in range(scratch.contacts):
        a, b = scratch.contact[k, 0], scratch.contact[k, 1]
        if i in (a, b) and w.health[a] > 0 and w.health[b] > 0:
            touching += 1.0
    gained = hazard_rate(task.collision_risk, 1.0) * touching if touching > 0 else 0.0
    scratch.harm[i] = harmed + gained
    scratch.cause[i] = COLLISION if gained > harmed else HAZARD


def count_overlaps(scratch: Scratch, health: Float[np.ndarray, "N"]) -> None:
    """Count the pairs that overlap, of which both live and of which one does."""
    scratch.both_live, scratch.one_lives = 0.0, 0.0
    for k in range(scratch.contacts):
        a, b = health[scratch.contact[k, 0]] > 0, health[scratch.contact[k, 1]] > 0
        if a and b:
            scratch.both_live += 1.0
        elif a or b:
            scratch.one_lives += 1.0


def keep_velocities(w: World, previous: Previous) -> None:
    """Remember how those move who lived before the step; the dead are seen with the last of it."""
    for i in range(len(w.health)):
        if previous.health[i] > 0:
            for axis in range(2):
                w.seen_velocity[i, axis] = w.velocity[i, axis]


def lay_out(scratch: Scratch, position: Float[np.ndarray, "N 2"], health: Float[np.ndarray, "N"]) -> None:
    """Note agents as things: the live ones are counted, the dead listed."""
    scratch.deaths = False
    for i in range(len(health)):
        dead = health[i] == 0
        scratch.x[i], scratch.y[i], scratch.dead[i] = position[i, 0], position[i, 1], dead
        scratch.kind[i] = HIDDEN if dead else AGENT
        scratch.deaths = scratch.deaths or dead


def look_around(scratch: Scratch, i: int, position: Float[np.ndarray, "N 2"], seen: Any) -> None:
    """Write whether one is dead, where one is, who is around by ring and sector, and the nearest dead."""
    count_around(i, scratch.x, scratch.y, scratch.kind, scratch.cell, scratch.count)
    seen.terminated[0] = 1.0 if scratch.dead[i] else 0.0
    for axis in range(2):
        seen.position[axis] = position[i, axis]
    write_counts(scratch.count, AGENT, seen.other_count)
    list_nearest(i, position, scratch.dead, scratch.deaths, seen.dead_position)


def list_other(w: World, i: int, j: int, visible: bool, seen: Any) -> None:
    """Write another agent's relative place and velocity, zeros where it is not visible."""
    slot = j if j < i else j - 1
    for axis in range(2):
        seen.other_position[slot, axis] = w.position[j, axis] - w.position[i, axis] if visible else 0.0
        seen.other_velocity[slot, axis] = moves(w, j, axis) - moves(w, i, axis) if visible else 0.0


def count_deaths(w: World, metrics: Metrics) -> None:
    """Count the dead by cause."""
    metrics.deaths_hazard, metrics.deaths_collision = 0.0, 0.0
    for i in range(len(w.health)):
        if w.health[i] == 0 and w.death_cause[i] == HAZARD:
            metrics.deaths_hazard += 1.0
        if w.health[i] == 0 and w.death_cause[i] == COLLISION:
            metrics.deaths_collision += 1.0


# --- declarations --------------------------------------------------------------------------------------


def physics_steps(spec: TaskSpec) -> int:
    """Physics steps per control step."""
    return 1


def scene(spec: TaskSpec, params: ParticleParams, radius: float, points: Mapping[str, str]) -> mujoco.MjSpec:
    """A floor with N particles of some radius, m, and points by name and kind of looks.

    Particle i's joints, looks and motors are prefixed ``drone<i>/``; points are mocap bodies, so that they
    are part of the row.
    """
    world = asset("arena.xml")
    world.option.timestep = spec.control_step
    world.option.integrator = mujoco.mjtIntegrator.mjINT_EULER
    # contacts are ours, and nothing moves out of the plane
    off = mujoco.mjtDisableBit
    world.option.disableflags = int(off.mjDSBL_CONTACT | off.mjDSBL_CONSTRAINT | off.mjDSBL_GRAVITY)
    factor = _factor(params)
    for i in range(spec.num_agents):
        particle = asset("particle.xml")
        for joint in particle.joints:
            joint.damping[0] = (factor - 1) / spec.control_step  # the other entries are of higher order
        for motor in particle.actuators:
            motor.group = i
            motor.gear[0] = factor
        particle.geom("foot").size[0] = radius
        attach(world, particle, f"drone{i}/")
    for name, kind in points.items():
        add_marker(world, name, kind).pos[2] = HEIGHT
    return world


def sizes(spec: TaskSpec, params: ParticleParams, points: int, counted: int) -> Mapping[str, int]:
    """Letters of axes: points in the world, and how many of them a histogram observation counts."""
    agents = spec.num_agents
    return {
        "L": points, "things": agents + counted, "cells": 3 * plane.CELLS,
        "pairs": agents * (agents - 1) // 2,
        "H": 0 if params.observation == "direct" else agents,
    }  # fmt: skip


def numbers(params: ParticleParams, radius: float, names: type) -> dict[str, Any]:
    """The entries of a record of numbers that particles have."""
    own = {"direct": params.observation == "direct", "radius": radius, "factor": _factor(params)}
    wanted = {**Numbers.__annotations__, **names.__annotations__}
    return {name: value for name, value in {**params.model_dump(), **own}.items() if name in wanted}


def own_blocks() -> tuple[Block, ...]:
    """What every observation begins with."""
    return (
        Block("terminated", (1,), "1", "-", "1 once dead", limits=SHARE),
        Block("velocity", (2,), "m/s", "world"),
        Block("position", (2,), "m", "world"),
    )


def count_block(name: str, unit: str, visible: str) -> Block:
    """Things around an agent, by ring and sector."""
    return Block(name, _CELLS, unit, "own", f"{IN_RANGE}, {visible}")


def around_blocks() -> tuple[Block, ...]:
    """What every histogram observation ends with, per step."""
    return (
        count_block("other_count", "agents", "live agents"),
        Block("dead_position", (LISTED, 2), "m", "own", "nearest dead agents, at any distance"),
    )


def observation(
    params: ParticleParams,
    *,
    both: tuple[Block, ...] = (),
    direct: tuple[Block, ...],
    histogram: tuple[Block, ...],
) -> tuple[Layout, int]:
    """An observation's layout, and how many numbers at its end are those of the step before.

    Both kinds of observation have the same blocks, so that one piece of machine code serves both; those of
    the other kind have size 0.
    """
    listed = params.observation == "direct"
    look = Layout((
        *own_blocks(), *both, *(block.without() if listed else block for block in histogram),
        *(block if listed else block.without() for block in direct),
    ))  # fmt: skip
    before = [
        Block(f"previous_{b.name}", b.shape, b.unit, b.frame, f"{b.visible}; one step ago, 0 at first")
        for b in look.blocks
    ]
    previous = 0 if listed else look.size
    return Layout((*look.blocks, *(block.without() if listed else block for block in before))), previous


def _factor(params: ParticleParams) -> float:
    return 1 / (1 - params.damping)
