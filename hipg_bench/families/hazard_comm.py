"""Hazardous communication: N relay drones carry messages between two terminals, past a hidden hazard.

Agents: N drones scattered in a box; two terminals that are too far apart to hear each other. Reward: 1 for
every step in which a chain of live drones links the terminals; a partial chain earns nothing. Hazard: hidden
near the straight line, wide enough that the straight chain runs through it; nobody ever sees it, but drones
see the wrecks it leaves. End: at the horizon.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import mujoco
import numpy as np
import pydantic
from jaxtyping import Bool, Float, Int

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
from hipg_bench.mechanics.geometry import distance3, rank_within
from hipg_bench.mechanics.hazards import hazard_rate, risk
from hipg_bench.mechanics.radio import count_hops
from hipg_bench.spec import TaskSpec

_MARKERS = {"terminal0": "terminal.xml", "terminal1": "terminal.xml", "hazard": "hazard.xml"}
_MARGIN = 0.1
"""Drones start at least this far from floor and ceiling, m."""

PHYSICS = {
    "QPOS": ("position",), "QVEL": ("velocity",), "CTRL": ("control",), "MOCAP_POS": ("terminal", "hazard"),
}  # fmt: skip
CAUSES = ("hazard",)
REASONS = ()
RENDERING = "hipg_bench.rendering.drones:Communication"
EXPERT = "hipg_bench.policies.scripted:DRONES_RELAY"


class Params(drones.DroneParams):
    """Numbers of hazardous communication.

    Attributes:
        terminal_gap: between the terminals, m; they stand at half the ceiling, in a random direction.
        link_range: of the radio, drone to drone and drone to terminal, m.
        hazard_radius: beyond it the hazard is harmless, m.
        hazard_peak: chance of death per 0.1 s at its centre.
        hazard_along: the hazard's centre lies within this distance of the middle, along the line, m.
        hazard_aside: and within this distance of the line, in a random direction, m.
        wrecks: how many dead drones a drone sees at most.
    """

    terminal_gap: float = pydantic.Field(gt=0, le=20)
    link_range: float = pydantic.Field(gt=0, le=20)
    hazard_radius: float = pydantic.Field(gt=0, le=5)
    hazard_peak: float = pydantic.Field(ge=0, lt=1)
    hazard_along: float = pydantic.Field(ge=0, le=10)
    hazard_aside: float = pydantic.Field(ge=0, le=5)
    wrecks: int = pydantic.Field(ge=1, le=30)


class World(drones.World):
    """What evolves."""

    terminal: Float[np.ndarray, "2 3"]  # m
    hazard: Float[np.ndarray, "3"]  # m
    connected: float  # steps in which the terminals were linked
    first_link: float  # step of the first of them
    chain: float  # drones in the shortest chain, summed over them


class Scratch(drones.Scratch):
    """What a step works out."""

    links: Bool[np.ndarray, "nodes nodes"]  # between terminals (nodes 0 and 1) and drones
    hops: Int[np.ndarray, "2 nodes"]  # links from each terminal to each node; -1 where there is no way
    queue: Int[np.ndarray, "nodes"]


class Numbers(drones.Numbers):
    """Numbers of the task; see `Params`."""

    terminal_gap: float
    link_range: float
    hazard_radius: float
    hazard_peak: float
    hazard_along: float
    hazard_aside: float


class Terms(family.Terms):
    """Parts of the team reward, before weights."""

    connected: float  # 1 while a chain of live drones links the terminals


class Metrics(family.Metrics):
    """Of an episode."""

    connected: float  # share of steps
    first_link: float  # control step; NaN where the terminals never were linked
    chain: float  # mean drones in the shortest chain while they were; NaN likewise


# --- rules, in the order of a step ---------------------------------------------------------------------


def begin(w: World, scratch: Scratch, task: Numbers, random: Float[np.ndarray, "C"]) -> None:
    """Turn the terminals' line, hide the hazard near it, scatter the drones."""
    angle, turn = 2 * math.pi * random[0], 2 * math.pi * random[3]
    cosine, sine = math.cos(angle), math.sin(angle)
    end, along = task.terminal_gap / 2, task.hazard_along * (2 * random[1] - 1)
    aside = task.hazard_aside * math.sqrt(random[2])
    for axis in range(3):
        line = cosine if axis == 0 else sine if axis == 1 else 0.0
        side = -sine if axis == 0 else cosine if axis == 1 else 0.0
        up = 1.0 if axis == 2 else 0.0
        middle = task.ceiling / 2 * up
        w.terminal[0, axis], w.terminal[1, axis] = middle - end * line, middle + end * line
        w.hazard[axis] = middle + along * line + aside * (math.cos(turn) * side + math.sin(turn) * up)
    half = task.half_width
    for i in range(len(w.health)):
        for axis in range(3):
            low = _MARGIN if axis == 2 else -half
            high = task.ceiling - _MARGIN if axis == 2 else half
            w.position[i, axis] = low + random[5 + 3 * i + axis] * (high - low)


act = drones.act


def read(w: World, scratch: Scratch, task: Numbers) -> None:
    """Work out distances and routes. Positions do not lag behind the physics."""
    find_neighbors(w, scratch)
    find_routes(w, scratch, task)


def find_routes(w: World, scratch: Scratch, task: Numbers) -> None:
    """Count links from each terminal to each node, over live drones; the terminals never hear each other."""
    agents, links, health = len(w.health), scratch.links, w.health
    links[0, 0] = links[0, 1] = links[1, 0] = links[1, 1] = False
    for i in range(agents):
        for k in range(2):
            near = health[i] > 0 and distance3(w.terminal[k], w.position[i]) < task.link_range
            links[k, 2 + i] = links[2 + i, k] = near
        for j in range(agents):
            near = scratch.apart[i, j] < task.link_range
            links[2 + i, 2 + j] = near and health[i] > 0 and health[j] > 0
    count_hops(links, 0, scratch.hops[0], scratch.queue)
    count_hops(links, 1, scratch.hops[1], scratch.queue)


def harm(w: World, previous: Previous, scratch: Scratch, task: Numbers) -> None:
    """The hazard harms whoever is within reach."""
    for i in range(len(w.health)):
        distance = distance3(w.hazard, w.position[i])
        if distance < task.hazard_radius:
            chance = risk(distance, task.hazard_radius, task.hazard_peak)
            scratch.harm[i] = hazard_rate(chance, task.reference_steps)


def update(w: World, previous: Previous, scratch: Scratch, task: Numbers) -> None:
    """Find routes without those who died; count connected steps and how long the chains were."""
    died = False
    for i in range(len(w.health)):
        died = died or w.health[i] != previous.health[i]
    if died:
        find_routes(w, scratch, task)
    chain = scratch.hops[0, 1]
    if chain > 0:
        if w.connected == 0:
            w.first_link = w.elapsed
        w.connected += 1
        w.chain += chain - 1


def reward(w: World, previous: Previous, scratch: Scratch, task: Numbers, terms: Terms) -> None:
    """Pay for a chain from terminal to terminal."""
    terms.connected = 1.0 if scratch.hops[0, 1] > 0 else 0.0


def observe(w: World, scratch: Scratch, task: Numbers, i: int, seen: Any) -> None:
    """Own motion exactly, both terminals, own routes, nearby live drones and nearby wrecks."""
    observe_self(w, i, seen)
    for k in range(2):
        seen.route[k] = 1.0 if scratch.hops[k, 2 + i] >= 0 else 0.0
        for axis in range(3):
            seen.terminal_position[k, axis] = w.terminal[k, axis] - w.position[i, axis]
    slots, wrecks, near, lost = len(seen.neighbor_seen), len(seen.wreck_seen), 0, 0
    count = rank_within(scratch.apart[i], task.sensing_radius, scratch.order, scratch.away)
    for k in range(count):
        j = scratch.order[k]
        if w.health[j] > 0:
            if near < slots:
                observe_neighbor(w, i, j, seen, near)
                near += 1
        elif lost < wrecks:
            seen.wreck_seen[lost] = 1.0
            for axis in range(3):
                seen.wreck_position[lost, axis] = w.position[j, axis] - w.position[i, axis]
            lost += 1
    for slot in range(near, slots):
        clear_neighbor(seen, slot)
    for slot in range(lost, wrecks):
        seen.wreck_seen[slot] = 0.0
        for axis in range(3):
            seen.wreck_position[slot, axis] = 0.0


def state(w: World, scratch: Scratch, task: Numbers, state: Any) -> None:
    """Everything, the hidden hazard included."""
    describe(w, state)
    for i in range(len(w.health)):
        for k in range(2):
            state.route[i, k] = 1.0 if scratch.hops[k, 2 + i] >= 0 else 0.0
    for axis in range(3):
        state.hazard_position[axis] = w.hazard[axis]
        for k in range(2):
            state.terminal_position[k, axis] = w.terminal[k, axis]


def metrics(w: World, scratch: Scratch, task: Numbers, metrics: Metrics) -> None:
    """How long the terminals were linked, since when, and by how many."""
    ever = w.connected > 0
    metrics.connected = w.connected / w.elapsed
    metrics.first_link = w.first_link if ever else math.nan
    metrics.chain = w.chain / w.connected if ever else math.nan


# --- declarations --------------------------------------------------------------------------------------

physics_steps = drones.physics_steps


def layout(spec: TaskSpec, params: Params) -> TaskLayout:
    """Agents see terminals, whether messages get there, live drones and wrecks; critics see everything."""
    n = spec.num_agents
    wrecks = min(n - 1, params.wrecks)
    within = f"within {params.sensing_radius:g} m"
    return TaskLayout(
        observation=Layout((
            Block("health", (1,), "1", limits=SHARE),
            Block("velocity", (3,), "m/s", "world"),
            Block("position", (3,), "m", "world"),
            Block("terminal_position", (2, 3), "m", "own"),
            Block("route", (2,), "1", "-",
                  "1 while the network carries messages to that terminal", limits=SHARE),
            *drones.neighbor_blocks(min(n - 1, params.neighbors), f"{within}, live drones"),
            Block("wreck_seen", (wrecks,), "1", "-", within, limits=SHARE),
            Block("wreck_position", (wrecks, 3), "m", "own", within),
        )),
        action=drones.ACTION,
        state=Layout((
            Block("health", (n,), "1", limits=SHARE),
            Block("position", (n, 3), "m", "world"),
            Block("velocity", (n, 3), "m/s", "world"),
            Block("route", (n, 2), "1", limits=SHARE),
            Block("terminal_position", (2, 3), "m", "world"),
            Block("hazard_position", (3,), "m", "world"),
        )),
    )  # fmt: skip


def scene(spec: TaskSpec, params: Params) -> mujoco.MjSpec:
    """N drones; terminals and hazard are mocap bodies, so that they are part of the row."""
    world = drones.drone_scene(spec, params)
    for name, kind in _MARKERS.items():
        add_marker(world, name, kind)
    return world


def num_random(spec: TaskSpec, params: Params) -> int:
    """Direction of the line, place of the hazard (one number is unused), and where drones start."""
    return 5 + 3 * spec.num_agents


def sizes(spec: TaskSpec, params: Params) -> Mapping[str, int]:
    """Nodes of the network are the terminals and the drones."""
    return {"nodes": spec.num_agents + 2, "most": spec.num_agents}


def numbers(spec: TaskSpec, params: Params) -> Mapping[str, Any]:
    """The family's entries of `Numbers`."""
    return drones.numbers(params, drones.Numbers) | drones.numbers(params, Numbers)
