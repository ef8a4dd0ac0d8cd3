"""The paper's hazardous navigation: N particles cover N landmarks; one more landmark kills.

Agents: N particles anywhere in a square, with N safe landmarks and a few hazardous ones. Reward: an agent
near every safe landmark. Hazard: a hazardous landmark looks like the others until any agent first comes
within its radius; death grows likelier towards its centre. Overlapping costs, but does not kill. End: at the
horizon. With no hazards it is the paper's cooperative navigation.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import mujoco
import numpy as np
import pydantic
from jaxtyping import Float, Int

from hipg_bench.families import family, particles
from hipg_bench.families.family import Previous
from hipg_bench.families.particles import (
    HIDDEN,
    POINT,
    burn,
    count_deaths,
    count_overlaps,
    crash,
    keep_velocities,
    lay_out,
    list_other,
    look_around,
    moves,
    scatter,
)
from hipg_bench.layout import SHARE, Block, Layout, TaskLayout
from hipg_bench.mechanics.plane import write_counts
from hipg_bench.spec import TaskSpec

PHYSICS, CAUSES, REASONS = particles.PHYSICS, particles.CAUSES, ()
RENDERING = "hipg_bench.rendering.drones:Navigation"
EXPERT = "hipg_bench.policies.scripted:PARTICLES_NAVIGATION"


class Params(particles.ParticleParams):
    """Numbers of the paper's navigation.

    Attributes:
        agent_radius: in a team of three, m; a larger team's agents shrink so that their area stays.
        hazards: how many landmarks are hazardous, beside the N safe ones.
        dead_cover: whether a dead agent still covers landmarks, as in the authors' code.
        uncovered_distance: charged for a landmark where only the living cover and nobody lives, m.
    """

    agent_radius: float = pydantic.Field(gt=0, le=1)
    hazards: int = pydantic.Field(ge=0, le=8)
    dead_cover: bool
    uncovered_distance: float = pydantic.Field(gt=0, le=20)


class World(particles.World):
    """What evolves; points are landmarks."""

    hazardous: Float[np.ndarray, "L"]
    revealed: Float[np.ndarray, "L"]  # hazardous, and known to be
    past_revealed: Float[np.ndarray, "L"]  # at the step before
    collisions: float
    covered: float


class Scratch(particles.Scratch):
    """What a step works out."""

    gap: float  # sum over safe landmarks of the distance to an agent, m
    order: Int[np.ndarray, "L"]


class Numbers(particles.Numbers):
    """Numbers of the task; see `Params`."""

    hazards: float
    dead_cover: bool
    uncovered_distance: float


class Terms(family.Terms):
    """Parts of the reward that every agent receives, before weights."""

    distance: float  # each agent is charged for all safe landmarks, m
    collision: float  # pairs of live agents that overlap, of which each is charged
    dead_overlap: float  # live agents on dead ones


class Metrics(particles.Metrics):
    """Of an episode."""

    covered: float  # sum over safe landmarks of the distance to the nearest agent, mean over steps, m
    collisions: float  # contacts of live pairs, all steps


# --- rules, in the order of a step ---------------------------------------------------------------------


def begin(w: World, scratch: Scratch, task: Numbers, random: Float[np.ndarray, "C"]) -> None:
    """Everything uniform in the square; which landmarks are hazardous is drawn too."""
    agents, points = len(w.health), len(w.hazardous)
    scatter(w, task, random)
    where, rank = random[2 * agents :], random[2 * (agents + points) :]
    for p in range(points):
        for axis in range(2):
            w.point[p, axis] = task.half_width * (2 * where[2 * p + axis] - 1)
        lower = 0
        for q in range(points):
            lower += 1 if rank[q] < rank[p] else 0
        scratch.order[lower] = p
    for p in range(points):
        w.hazardous[p] = 1.0 if scratch.order[p] < task.hazards else 0.0
    for i in range(agents):
        for p in range(points):
            if w.hazardous[p] > 0 and burn(w, task, i, p) >= 0:
                w.revealed[p] = 1.0


def act(
    w: World, previous: Previous, scratch: Scratch, task: Numbers, command: Float[np.ndarray, "N 2"]
) -> None:
    """Push the living; note what was known before the step."""
    for p in range(len(w.revealed)):
        w.past_revealed[p] = w.revealed[p]
    particles.act(w, previous, scratch, task, command)


read = particles.read


def harm(w: World, previous: Previous, scratch: Scratch, task: Numbers) -> None:
    """Hazards and contacts harm; a hazard is revealed for good once an agent, dead or alive, is in it."""
    for p in range(len(w.hazardous)):
        if w.hazardous[p] > 0:
            for i in range(len(w.health)):
                gained = burn(w, task, i, p)
                if gained >= 0:
                    w.revealed[p] = 1.0
                    scratch.harm[i] += gained
    for i in range(len(w.health)):
        crash(w, scratch, task, i)


def update(w: World, previous: Previous, scratch: Scratch, task: Numbers) -> None:
    """Work out who overlaps, and how far the safe landmarks are from those who cover."""
    count_overlaps(scratch, w.health)
    scratch.gap, position, point, health = 0.0, w.position, w.point, w.health
    for p in range(len(point)):
        if w.hazardous[p] == 0:
            nearest = math.inf
            for i in range(len(health)):
                if task.dead_cover or health[i] > 0:
                    x, y = point[p, 0] - position[i, 0], point[p, 1] - position[i, 1]
                    nearest = min(nearest, x * x + y * y)
            scratch.gap += task.uncovered_distance if nearest == math.inf else math.sqrt(nearest)
    w.collisions += scratch.both_live
    w.covered += scratch.gap
    keep_velocities(w, previous)


def reward(w: World, previous: Previous, scratch: Scratch, task: Numbers, terms: Terms) -> None:
    """Charge every agent."""
    terms.distance = len(w.health) * scratch.gap
    terms.collision, terms.dead_overlap = scratch.both_live, scratch.one_lives


def survey(w: World, scratch: Scratch, task: Numbers) -> None:
    """Note agents and landmarks as things of a kind, for histograms."""
    if not task.direct:
        note_things(scratch, w.position, w.health, w.point, w.revealed)


def note_things(
    scratch: Scratch,
    position: Float[np.ndarray, "N 2"],
    health: Float[np.ndarray, "N"],
    point: Float[np.ndarray, "L 3"],
    revealed: Float[np.ndarray, "L"],
) -> None:
    """Agents, then landmarks: the revealed ones are not counted."""
    lay_out(scratch, position, health)
    for p in range(len(point)):
        k = len(health) + p
        scratch.x[k], scratch.y[k] = point[p, 0], point[p, 1]
        scratch.kind[k] = HIDDEN if revealed[p] > 0 else POINT


def observe(w: World, scratch: Scratch, task: Numbers, i: int, seen: Any) -> None:
    """Landmarks and other agents, counted around oneself or listed."""
    if not task.direct:
        for axis in range(2):
            seen.velocity[axis] = moves(w, i, axis)
        look_around(scratch, i, w.position, seen)
        look_at_points(w, scratch, i, w.position, w.revealed, seen)
        return
    seen.terminated[0] = 1.0 if w.health[i] == 0 else 0.0
    for axis in range(2):
        seen.velocity[axis], seen.position[axis] = moves(w, i, axis), w.position[i, axis]
    for p in range(len(w.hazardous)):
        seen.point_revealed[p] = w.revealed[p]
        for axis in range(2):
            seen.point_position[p, axis] = w.point[p, axis] - w.position[i, axis]
    for j in range(len(w.health)):
        if j != i:
            seen.other_terminated[j if j < i else j - 1] = 1.0 if w.health[j] == 0 else 0.0
            list_other(w, i, j, w.health[j] > 0, seen)


def look_at_points(
    w: World,
    scratch: Scratch,
    i: int,
    position: Float[np.ndarray, "N 2"],
    revealed: Float[np.ndarray, "L"],
    seen: Any,
) -> None:
    """Write unrevealed landmarks by ring and sector, and the nearest revealed hazard."""
    write_counts(scratch.count, POINT, seen.point_count)
    nearest = math.inf
    seen.hazard_position[0], seen.hazard_position[1] = 0.0, 0.0
    for p in range(len(revealed)):
        if revealed[p] > 0:
            x, y = w.point[p, 0] - position[i, 0], w.point[p, 1] - position[i, 1]
            if x * x + y * y < nearest:
                nearest = x * x + y * y
                seen.hazard_position[0], seen.hazard_position[1] = x, y


def observe_previous(w: World, scratch: Scratch, task: Numbers, i: int, seen: Any) -> bool:
    """What was observed in the step before, from what the row remembers of it."""
    if task.blank_dead and w.past_health[i] == 0:
        return False
    note_things(scratch, w.past_position, w.past_health, w.point, w.past_revealed)
    for axis in range(2):
        seen.velocity[axis] = w.past_velocity[i, axis]
    look_around(scratch, i, w.past_position, seen)
    look_at_points(w, scratch, i, w.past_position, w.past_revealed, seen)
    return True


def state(w: World, scratch: Scratch, task: Numbers, state: Any) -> None:
    """Five numbers per agent and landmark: place, velocity, and dead or hazardous."""
    for i in range(len(w.health)):
        state.terminated[i] = 1.0 if w.health[i] == 0 else 0.0
        for axis in range(2):
            state.position[i, axis], state.velocity[i, axis] = w.position[i, axis], moves(w, i, axis)
    for p in range(len(w.hazardous)):
        state.point_hazardous[p] = w.hazardous[p]
        for axis in range(2):
            state.point_position[p, axis], state.point_velocity[p, axis] = w.point[p, axis], 0.0


def metrics(w: World, scratch: Scratch, task: Numbers, metrics: Metrics) -> None:
    """How well landmarks were covered, and what it took."""
    metrics.covered, metrics.collisions = w.covered / w.elapsed, w.collisions
    count_deaths(w, metrics)


# --- declarations --------------------------------------------------------------------------------------

physics_steps = particles.physics_steps


def layout(spec: TaskSpec, params: Params) -> TaskLayout:
    """Agents see landmarks and each other, listed or counted; critics see everything."""
    n = spec.num_agents
    points, others = n + params.hazards, (n - 1,)
    observation, previous = particles.observation(
        params,
        direct=(
            Block("point_position", (points, 2), "m", "own"),
            Block("point_revealed", (points,), "1", "-",
                  "1 on hazards that an agent came upon", limits=SHARE),
            Block("other_terminated", others, "1", "-", "1 once dead", limits=SHARE),
            Block("other_position", (*others, 2), "m", "own", "while that agent lives"),
            Block("other_velocity", (*others, 2), "m/s", "own", "while that agent lives"),
        ),
        histogram=(
            particles.count_block("point_count", "landmarks", "unrevealed"),
            Block("hazard_position", (2,), "m", "own", "nearest revealed hazard, at any distance"),
            *particles.around_blocks(),
        ),
    )  # fmt: skip
    return TaskLayout(
        observation=observation,
        previous=previous,
        action=particles.ACTION,
        state=Layout((
            Block("terminated", (n,), "1", limits=SHARE),
            Block("position", (n, 2), "m", "world"),
            Block("velocity", (n, 2), "m/s", "world"),
            Block("point_hazardous", (points,), "1", limits=SHARE),
            Block("point_position", (points, 2), "m", "world"),
            Block("point_velocity", (points, 2), "m/s", "world", "never: landmarks stand still"),
        )),
        health_block="terminated",
        dead_value=1.0,
    )  # fmt: skip


def scene(spec: TaskSpec, params: Params) -> mujoco.MjSpec:
    """N particles and all landmarks."""
    points = {f"point{i}": "point.xml" for i in range(spec.num_agents + params.hazards)}
    return particles.scene(spec, params, _radius(spec, params), points)


def num_random(spec: TaskSpec, params: Params) -> int:
    """Where agents and landmarks are, and an order of the landmarks."""
    return 2 * spec.num_agents + 3 * (spec.num_agents + params.hazards)


def sizes(spec: TaskSpec, params: Params) -> Mapping[str, int]:
    """Hazards beside as many safe landmarks as agents; all of them are counted."""
    points = spec.num_agents + params.hazards
    return particles.sizes(spec, params, points, counted=points)


def numbers(spec: TaskSpec, params: Params) -> Mapping[str, Any]:
    """The family's entries of `Numbers`."""
    return particles.numbers(params, _radius(spec, params), Numbers)


def _radius(spec: TaskSpec, params: Params) -> float:
    return params.agent_radius * (3 / spec.num_agents) ** 0.5
