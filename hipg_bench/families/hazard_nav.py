"""Hazard navigation: N drones watch N monitor points, some of which kill.

Agents: N drones that take off from the ground. Reward: a live drone near every point, all the time. Hazard: a
few points lie in a hazard that looks like any other point until a drone first comes within its radius; from
then on every drone knows it. Death grows likelier towards its centre. A hazardous point is still worth
watching, from its edge. End: at the horizon, never before.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import mujoco
import numpy as np
import pydantic
from jaxtyping import Float

from hipg_bench.families import drones, family
from hipg_bench.families.drones import (
    clear_neighbor,
    describe,
    find_neighbors,
    observe_neighbor,
    observe_self,
)
from hipg_bench.families.family import Previous
from hipg_bench.families.scene import add_marker
from hipg_bench.layout import SHARE, Block, Layout, TaskLayout
from hipg_bench.mechanics.geometry import distance3, mean, rank_within
from hipg_bench.mechanics.hazards import hazard_rate, risk
from hipg_bench.spec import TaskSpec

CANDIDATES = 8
"""Layouts of points drawn per episode, of which the most spread one is used."""
LOWEST_TAKE_OFF, HIGHEST_TAKE_OFF = 0.1, 0.25
"""Height of drones at the start, m."""
LOWEST_POINT, HIGHEST_POINT = 0.4, 0.9
"""Height of points, as a share of the ceiling."""

PHYSICS = {"QPOS": ("position",), "QVEL": ("velocity",), "CTRL": ("control",), "MOCAP_POS": ("point",)}
CAUSES = ("hazard",)
REASONS = ()
RENDERING = "hipg_bench.rendering.drones:Navigation"
EXPERT = "hipg_bench.policies.scripted:DRONES_NAVIGATION"


class Params(drones.DroneParams):
    """Numbers of hazard navigation.

    Attributes:
        hazards: how many of the N points are hazardous.
        hazard_radius: beyond it a hazard is harmless, m.
        hazard_peak: chance of death per 0.1 s at its centre.
        uncovered_distance: charged for a point when no drone is nearer or alive, m.
    """

    hazards: int = pydantic.Field(ge=0, le=31)
    hazard_radius: float = pydantic.Field(gt=0, le=5)
    hazard_peak: float = pydantic.Field(ge=0, lt=1)
    uncovered_distance: float = pydantic.Field(gt=0, le=20)


class World(drones.World):
    """What evolves."""

    point: Float[np.ndarray, "P 3"]  # m
    hazardous: Float[np.ndarray, "P"]
    revealed: Float[np.ndarray, "P"]  # hazardous, and known to be
    collisions: float
    covered: float


class Scratch(drones.Scratch):
    """What a step works out."""

    distance: Float[np.ndarray, "N P"]  # drone to point, m
    nearest: Float[np.ndarray, "P"]  # point to live drone, m
    gap: float  # mean of it
    touching: float  # pairs of live drones
    candidate: Float[np.ndarray, "P 3"]


class Numbers(drones.Numbers):
    """Numbers of the task; see `Params`."""

    hazards: float
    hazard_radius: float
    hazard_peak: float
    uncovered_distance: float


class Terms(family.Terms):
    """Parts of the team reward, before weights."""

    distance: float  # mean over points to the nearest live drone, m
    collision: float  # pairs that touch


class Metrics(family.Metrics):
    """Of an episode."""

    covered: float  # mean distance from a point to its nearest live drone, m
    collisions: float
    revealed: float


# --- rules, in the order of a step ---------------------------------------------------------------------


def begin(w: World, scratch: Scratch, task: Numbers, random: Float[np.ndarray, "C"]) -> None:
    """Spread the points over the box, the first few of them hazardous; drones start near the ground."""
    points, half, place = len(w.point), task.half_width, scratch.candidate
    low, high = LOWEST_POINT * task.ceiling, HIGHEST_POINT * task.ceiling
    widest = -1.0
    for c in range(CANDIDATES):
        closest = math.inf
        for p in range(points):
            drawn = random[3 * (c * points + p) :]
            place[p, 0], place[p, 1] = drawn[0] * (half + half) - half, drawn[1] * (half + half) - half
            place[p, 2] = low + drawn[2] * (high - low)
            for q in range(p):
                closest = min(closest, distance3(place[q], place[p]))
        if closest > widest:
            widest = closest
            for p in range(points):
                for axis in range(3):
                    w.point[p, axis] = place[p, axis]
    for p in range(points):
        # points are exchangeable, and agents never see their order: the first ones may be the hazards
        w.hazardous[p] = 1.0 if p < task.hazards else 0.0
    for i in range(len(w.health)):
        drawn = random[3 * (CANDIDATES * points + i) :]
        w.position[i, 0], w.position[i, 1] = drawn[0] * (half + half) - half, drawn[1] * (half + half) - half
        w.position[i, 2] = LOWEST_TAKE_OFF + drawn[2] * (HIGHEST_TAKE_OFF - LOWEST_TAKE_OFF)


act = drones.act


def read(w: World, scratch: Scratch, task: Numbers) -> None:
    """Work out distances. Positions do not lag behind the physics: they are generalised coordinates."""
    position, point, distance = w.position, w.point, scratch.distance
    for i in range(len(position)):
        for p in range(len(point)):
            distance[i, p] = distance3(position[i], point[p])
    find_neighbors(w, scratch)


def harm(w: World, previous: Previous, scratch: Scratch, task: Numbers) -> None:
    """Hazards harm whoever is within reach; one is revealed for good once a live drone comes there."""
    for i in range(len(w.health)):
        for p in range(len(w.hazardous)):
            if w.hazardous[p] > 0 and scratch.distance[i, p] < task.hazard_radius:
                chance = risk(scratch.distance[i, p], task.hazard_radius, task.hazard_peak)
                scratch.harm[i] += hazard_rate(chance, task.reference_steps)
                if previous.health[i] > 0:
                    w.revealed[p] = 1.0


def update(w: World, previous: Previous, scratch: Scratch, task: Numbers) -> None:
    """Work out how well the living cover the points, and who touches whom."""
    agents, touching = len(w.health), 0.0
    for p in range(len(scratch.nearest)):
        nearest = task.uncovered_distance
        for i in range(agents):
            if w.health[i] > 0:
                nearest = min(nearest, scratch.distance[i, p])
        scratch.nearest[p] = nearest
    for i in range(agents):
        for j in range(i):
            if scratch.apart[i, j] < 2 * task.drone_radius and w.health[i] > 0 and w.health[j] > 0:
                touching += 1.0
    scratch.gap, scratch.touching = mean(scratch.nearest), touching
    w.collisions += touching
    w.covered += scratch.gap


def reward(w: World, previous: Previous, scratch: Scratch, task: Numbers, terms: Terms) -> None:
    """Charge for uncovered points and for collisions."""
    terms.distance, terms.collision = scratch.gap, scratch.touching


def observe(w: World, scratch: Scratch, task: Numbers, i: int, seen: Any) -> None:
    """Own motion exactly, all points, and the nearest drones within the sensing radius."""
    observe_self(w, i, seen)
    points, order, away = len(w.point), scratch.order, scratch.away
    rank_within(scratch.distance[i], math.inf, order, away)
    for k in range(points):
        p = order[k]
        for axis in range(3):
            seen.point_position[k, axis] = w.point[p, axis] - w.position[i, axis]
        seen.point_hazardous[k] = w.revealed[p]
        gap = task.sensing_radius
        for j in range(len(w.health)):
            if scratch.apart[i, j] <= task.sensing_radius and w.health[j] > 0:
                gap = min(gap, scratch.distance[j, p])
        seen.point_gap[k] = gap
    count = rank_within(scratch.apart[i], task.sensing_radius, order, away)
    for slot in range(len(seen.neighbor_seen)):
        if slot < count:
            observe_neighbor(w, i, order[slot], seen, slot)
        else:
            clear_neighbor(seen, slot)


def state(w: World, scratch: Scratch, task: Numbers, state: Any) -> None:
    """Everything, the hidden hazards included."""
    describe(w, state)
    for p in range(len(w.point)):
        state.point_hazardous[p], state.point_revealed[p] = w.hazardous[p], w.revealed[p]
        for axis in range(3):
            state.point_position[p, axis] = w.point[p, axis]


def metrics(w: World, scratch: Scratch, task: Numbers, metrics: Metrics) -> None:
    """How well points were covered, and what it took."""
    metrics.covered, metrics.collisions, metrics.revealed = w.covered / w.elapsed, w.collisions, 0.0
    for p in range(len(w.revealed)):
        metrics.revealed += w.revealed[p]


# --- declarations --------------------------------------------------------------------------------------

physics_steps = drones.physics_steps


def layout(spec: TaskSpec, params: Params) -> TaskLayout:
    """Agents see their own motion, all points and the nearest drones; critics see everything."""
    n = points = spec.num_agents
    within = f"within {params.sensing_radius:g} m"
    return TaskLayout(
        observation=Layout((
            Block("health", (1,), "1", limits=SHARE),
            Block("velocity", (3,), "m/s", "world"),
            Block("position", (3,), "m", "world"),
            Block("point_position", (points, 3), "m", "own", "always, nearest point first"),
            Block("point_hazardous", (points,), "1", "-",
                  "once any drone came within its radius", limits=SHARE),
            Block("point_gap", (points,), "m", "-", f"to the nearest other live drone {within}"),
            *drones.neighbor_blocks(min(n - 1, params.neighbors), within),
        )),
        action=drones.ACTION,
        state=Layout((
            Block("health", (n,), "1", limits=SHARE),
            Block("position", (n, 3), "m", "world"),
            Block("velocity", (n, 3), "m/s", "world"),
            Block("point_position", (points, 3), "m", "world"),
            Block("point_hazardous", (points,), "1", limits=SHARE),
            Block("point_revealed", (points,), "1", limits=SHARE),
        )),
    )  # fmt: skip


def scene(spec: TaskSpec, params: Params) -> mujoco.MjSpec:
    """N drones and N points; the points are mocap bodies, so that they are part of the row."""
    world = drones.drone_scene(spec, params)
    for i in range(spec.num_agents):
        add_marker(world, f"point{i}", "point.xml")
    return world


def num_random(spec: TaskSpec, params: Params) -> int:
    """Candidate layouts of the points, and where drones start."""
    return 3 * spec.num_agents * (CANDIDATES + 1)


def sizes(spec: TaskSpec, params: Params) -> Mapping[str, int]:
    """As many points as drones."""
    return {"P": spec.num_agents, "most": spec.num_agents}


def numbers(spec: TaskSpec, params: Params) -> Mapping[str, Any]:
    """The family's entries of `Numbers`."""
    return drones.numbers(params, drones.Numbers) | drones.numbers(params, Numbers)
