"""The paper's hazardous communication: a chain of N particles links two terminals, past a hidden hazard.

Agents: N small particles anywhere in a square, with two terminals on opposite sides and a hazard on the
line between them. Reward: every step in which live agents link the terminals; a partial chain earns
nothing. Hazard: the one on the line, which nobody ever sees, and touching one another. The dead do not
relay; their places are the only hint of the hazard. End: at the horizon.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import mujoco
import numpy as np
import pydantic
from jaxtyping import Bool, Float, Int

from hipg_bench.families import family, particles
from hipg_bench.families.family import Previous
from hipg_bench.families.particles import (
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
from hipg_bench.mechanics.plane import is_linked, length
from hipg_bench.spec import TaskSpec

_MARKERS = {"terminal0": "terminal.xml", "terminal1": "terminal.xml", "hazard": "hazard.xml"}
THE_HAZARD = 2
"""Points 0 and 1 are the terminals."""

PHYSICS, CAUSES, REASONS = particles.PHYSICS, particles.CAUSES, ()
RENDERING = "hipg_bench.rendering.drones:Communication"
EXPERT = "hipg_bench.policies.scripted:PARTICLES_RELAY"


class Params(particles.ParticleParams):
    """Numbers of the paper's communication.

    Attributes:
        agent_radius: m.
        terminal_gap: between the terminals, m; the origin is their middle, their direction is random.
        hazard_along: the hazard lies on the terminals' line within this distance of the middle, m.
        link_scale, link_power, link_offset: a team of n hears as far as scale * n^power + offset, m.
    """

    agent_radius: float = pydantic.Field(gt=0, le=1)
    terminal_gap: float = pydantic.Field(gt=0, le=20)
    hazard_along: float = pydantic.Field(ge=0, le=10)
    link_scale: float = pydantic.Field(gt=0, le=10)
    link_power: float = pydantic.Field(ge=-1, le=1)
    link_offset: float = pydantic.Field(ge=-1, le=10)


class World(particles.World):
    """What evolves; points are the two terminals and the hazard."""

    connected: float  # whether live agents link the terminals
    connected_steps: float
    collisions: float


class Scratch(particles.Scratch):
    """What a step works out."""

    reached: Bool[np.ndarray, "N"]  # who hears terminal 0, over others
    queue: Int[np.ndarray, "N"]


class Numbers(particles.Numbers):
    """Numbers of the task; see `Params`."""

    terminal_gap: float
    hazard_along: float
    link_range: float


class Terms(family.Terms):
    """Parts of the reward that every agent receives, before weights."""

    connected: float  # N while the terminals are linked: what every agent receives


class Metrics(particles.Metrics):
    """Of an episode."""

    connected: float  # share of steps
    collisions: float  # contacts of live pairs, all steps


# --- rules, in the order of a step ---------------------------------------------------------------------


def begin(w: World, scratch: Scratch, task: Numbers, random: Float[np.ndarray, "C"]) -> None:
    """Turn the terminals' line, hide the hazard on it, scatter the agents."""
    angle, along = 2 * math.pi * random[0], task.hazard_along * (2 * random[1] - 1)
    for axis in range(2):
        line = math.cos(angle) if axis == 0 else math.sin(angle)
        end = task.terminal_gap / 2 * line
        w.point[0, axis], w.point[1, axis], w.point[THE_HAZARD, axis] = -end, end, along * line
    scatter(w, task, random[2:])
    # those who stand well at the start are linked before the first step
    w.connected = 1.0 if is_connected(w, scratch, task) else 0.0


act, read = particles.act, particles.read


def harm(w: World, previous: Previous, scratch: Scratch, task: Numbers) -> None:
    """The hazard and contacts harm."""
    for i in range(len(w.health)):
        scratch.harm[i] = max(burn(w, task, i, THE_HAZARD), 0.0)
        crash(w, scratch, task, i)


def update(w: World, previous: Previous, scratch: Scratch, task: Numbers) -> None:
    """Work out whether the living link the terminals, and who overlapped before anybody died."""
    w.connected = 1.0 if is_connected(w, scratch, task) else 0.0
    w.connected_steps += w.connected
    count_overlaps(scratch, previous.health)
    w.collisions += scratch.both_live
    keep_velocities(w, previous)


def is_connected(w: World, scratch: Scratch, task: Numbers) -> bool:
    """Whether live agents link the terminals; terminals do not hear each other."""
    return is_linked(w.position, w.health, w.point, task.link_range, scratch.reached, scratch.queue)


def hears(w: World, task: Numbers, i: int, j: int) -> bool:
    """Whether two agents live and are within range of each other."""
    x, y = w.position[j, 0] - w.position[i, 0], w.position[j, 1] - w.position[i, 1]
    return w.health[i] > 0 and w.health[j] > 0 and length(x, y) <= task.link_range


def reward(w: World, previous: Previous, scratch: Scratch, task: Numbers, terms: Terms) -> None:
    """Pay every agent while the terminals are linked."""
    terms.connected = len(w.health) * w.connected


def survey(w: World, scratch: Scratch, task: Numbers) -> None:
    """Note agents as things, for histograms."""
    if not task.direct:
        lay_out(scratch, w.position, w.health)


def observe(w: World, scratch: Scratch, task: Numbers, i: int, seen: Any) -> None:
    """Both terminals; other agents, counted around oneself or as far as one hears them."""
    for axis in range(2):
        seen.velocity[axis] = moves(w, i, axis)
    if not task.direct:
        look_around(scratch, i, w.position, seen)
        observe_terminals(w, seen)
        if w.health[i] == 0:
            hear_nobody(seen)
        return
    seen.terminated[0] = 1.0 if w.health[i] == 0 else 0.0
    for axis in range(2):
        seen.position[axis] = w.position[i, axis]
    observe_terminals(w, seen)
    for j in range(len(w.health)):
        if j != i:
            seen.other_terminated[j if j < i else j - 1] = 0.0  # the dead are silent
            list_other(w, i, j, hears(w, task, i, j), seen)


def observe_terminals(w: World, seen: Any) -> None:
    """Write where the terminals are."""
    for k in range(2):
        for axis in range(2):
            seen.terminal_position[k, axis] = w.point[k, axis]


def hear_nobody(seen: Any) -> None:
    """The dead, where they observe at all, know of no live agent."""
    for ring in range(len(seen.other_count)):
        for sector in range(seen.other_count.shape[1]):
            seen.other_count[ring, sector] = 0.0


def observe_previous(w: World, scratch: Scratch, task: Numbers, i: int, seen: Any) -> bool:
    """What was observed in the step before, from what the row remembers of it."""
    if task.blank_dead and w.past_health[i] == 0:
        return False
    lay_out(scratch, w.past_position, w.past_health)
    for axis in range(2):
        seen.velocity[axis] = w.past_velocity[i, axis]
    look_around(scratch, i, w.past_position, seen)
    observe_terminals(w, seen)
    if w.past_health[i] == 0:
        hear_nobody(seen)
    return True


def state(w: World, scratch: Scratch, task: Numbers, state: Any) -> None:
    """Five numbers per agent, terminal and hazard: place, velocity, and dead or hazardous."""
    for i in range(len(w.health)):
        state.terminated[i] = 1.0 if w.health[i] == 0 else 0.0
        for axis in range(2):
            state.position[i, axis], state.velocity[i, axis] = w.position[i, axis], moves(w, i, axis)
    for k in range(len(state.marker_hazardous)):
        state.marker_hazardous[k] = 1.0 if k == THE_HAZARD else 0.0
        for axis in range(2):
            state.marker_velocity[k, axis] = 0.0
    for axis in range(2):
        state.hazard_position[axis] = w.point[THE_HAZARD, axis]
        for k in range(2):
            state.terminal_position[k, axis] = w.point[k, axis]


def metrics(w: World, scratch: Scratch, task: Numbers, metrics: Metrics) -> None:
    """How long the terminals were linked, and what it took."""
    metrics.connected, metrics.collisions = w.connected_steps / w.elapsed, w.collisions
    count_deaths(w, metrics)


# --- declarations --------------------------------------------------------------------------------------

physics_steps = particles.physics_steps


def layout(spec: TaskSpec, params: Params) -> TaskLayout:
    """Agents see the terminals and each other, listed or counted; critics see everything."""
    n = spec.num_agents
    others, heard = (n - 1,), f"alive and within {link_range(spec, params):.4g} m"
    terminals = Block("terminal_position", (2, 2), "m", "world")
    observation, previous = particles.observation(
        params,
        both=(terminals,),
        direct=(
            Block("other_terminated", others, "1", "-",
                  f"{heard}, so that it is 0: the dead are silent", limits=SHARE),
            Block("other_position", (*others, 2), "m", "own", heard),
            Block("other_velocity", (*others, 2), "m/s", "own", heard),
        ),
        histogram=particles.around_blocks(),
    )  # fmt: skip
    return TaskLayout(
        observation=observation,
        previous=previous,
        action=particles.ACTION,
        state=Layout((
            Block("terminated", (n,), "1", limits=SHARE),
            Block("position", (n, 2), "m", "world"),
            Block("velocity", (n, 2), "m/s", "world"),
            terminals,
            Block("hazard_position", (2,), "m", "world"),
            Block("marker_hazardous", (3,), "1", "-", "terminals 0, hazard 1", limits=SHARE),
            Block("marker_velocity", (3, 2), "m/s", "world", "never: they stand still"),
        )),
        health_block="terminated",
        dead_value=1.0,
    )  # fmt: skip


def scene(spec: TaskSpec, params: Params) -> mujoco.MjSpec:
    """N particles, terminals and hazard."""
    return particles.scene(spec, params, params.agent_radius, _MARKERS)


def num_random(spec: TaskSpec, params: Params) -> int:
    """Direction of the line, place of the hazard, and where agents are."""
    return 2 + 2 * spec.num_agents


def sizes(spec: TaskSpec, params: Params) -> Mapping[str, int]:
    """Terminals and the hazard are not counted in observations."""
    return particles.sizes(spec, params, len(_MARKERS), counted=0)


def numbers(spec: TaskSpec, params: Params) -> Mapping[str, Any]:
    """The family's entries of `Numbers`."""
    own = particles.numbers(params, params.agent_radius, Numbers)
    return {**own, "link_range": link_range(spec, params)}


def link_range(spec: TaskSpec, params: Params) -> float:
    """How far a team hears, m."""
    return params.link_scale * spec.num_agents**params.link_power + params.link_offset
