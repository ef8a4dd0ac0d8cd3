"""Hazardous communication: N relay drones carry messages between two terminals, past a hidden killer.

Who: N drones scattered in a box; two terminals that are too far apart to hear each other. What
pays: 1 for every step in which a chain of live drones links the terminals; a partial chain pays
nothing. What hurts: a hidden hazard near the straight line, wide enough that the straight chain runs
through it; nobody ever sees it, but drones see the wrecks it leaves. When it ends: at the horizon.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import mujoco
import numpy as np
import pydantic
from jaxtyping import Bool, Float, Int, Int8

from hipg_bench.families import drones
from hipg_bench.families.family import EVERY, Harm, Rows
from hipg_bench.families.scene import add_marker
from hipg_bench.layout import SHARE, Block, Layout, TaskLayout
from hipg_bench.mechanics import coverage, hazards, health, radio, sensing
from hipg_bench.native import on_threads
from hipg_bench.sim import Sim
from hipg_bench.spec import TaskSpec, parse

_A, _B, _HAZARD = 0, 1, 2
"""Markers: the two terminals and the hazard."""


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


@dataclasses.dataclass(kw_only=True)
class Snapshot:
    """The world at the end of a control step; all but health has the worlds last."""

    position: Float[np.ndarray, "3 N B"]  # m
    velocity: Float[np.ndarray, "3 N B"]  # m/s
    health: Float[np.ndarray, "B N"]
    threads: int
    terminal: Float[np.ndarray, "3 2 B"]  # m
    hazard: Float[np.ndarray, "3 1 B"]  # m
    apart: Float[np.ndarray, "N N B"]  # drone to drone, infinite to oneself, m
    away: Float[np.ndarray, "2 N B"]  # terminal to drone, m
    hops: Int8[np.ndarray, "2 N+2 B"]  # links from each terminal to each node; -1 where there is no way


class HazardComm:
    """Rules of hazardous communication; see `hipg_bench.families.family.Family` for each method."""

    causes: tuple[str, ...] = ("hazard",)
    metrics: tuple[str, ...] = ("connected", "first_link", "chain")

    def __init__(self, spec: TaskSpec) -> None:
        self.spec = spec
        self.params = params = parse(Params, spec.params, spec.task)
        n = spec.num_agents
        self.physics_steps = drones.physics_steps(spec)
        self.fields: Mapping[str, int] = {"connected": 1, "first_link": 1, "chain": 1}
        self.chance_size = 5 + n * 3
        self._slots = min(n - 1, params.neighbors)
        self._wrecks = min(n - 1, params.wrecks)
        within = f"within {params.sensing_radius:g} m"
        self.layout = TaskLayout(
            observation=Layout((
                Block("health", (1,), "1", limits=SHARE),
                Block("velocity", (3,), "m/s", "world"),
                Block("position", (3,), "m", "world"),
                Block("terminal_position", (2, 3), "m", "own"),
                Block("route", (2,), "1", "-",
                      "1 while the network carries messages to that terminal", limits=SHARE),
                *drones.neighbor_blocks(self._slots, f"{within}, live drones"),
                Block("wreck_seen", (self._wrecks,), "1", "-", within, limits=SHARE),
                Block("wreck_position", (self._wrecks, 3), "m", "own", within),
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

    def scene(self) -> mujoco.MjSpec:
        """N drones; terminals and hazard are mocap bodies, so that they are part of the row."""
        scene = drones.drone_scene(self.spec, self.params)
        for name, kind in (
            ("terminal0", "terminal.xml"),
            ("terminal1", "terminal.xml"),
            ("hazard", "hazard.xml"),
        ):
            add_marker(scene, name, kind)
        return scene

    def reset(self, sim: Sim, ids: Int[np.ndarray, "n"], chance: Float[np.ndarray, "n K"]) -> None:
        """Turn the terminals' line, hide the hazard near it, scatter the drones."""
        n, params = self.spec.num_agents, self.params
        angle, along, aside, around = 2 * np.pi * chance[:, 0], *(chance[:, k] for k in (1, 2, 3))
        line = np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=-1)
        side = np.stack([-np.sin(angle), np.cos(angle), np.zeros_like(angle)], axis=-1)
        up = np.array([0.0, 0.0, 1.0])
        middle = np.array([0.0, 0.0, params.ceiling / 2])
        turn = 2 * np.pi * around[:, None]
        off_line = params.hazard_aside * np.sqrt(aside)[:, None] * (np.cos(turn) * side + np.sin(turn) * up)
        hazard = middle + params.hazard_along * (2 * along[:, None] - 1) * line + off_line
        end = params.terminal_gap / 2 * line
        sim.marker[ids] = np.stack([middle - end, middle + end, hazard], axis=1)
        half, margin = params.half_width, 0.1
        low, high = np.array([-half, -half, margin]), np.array([half, half, params.ceiling - margin])
        drones.place(sim, ids, low + chance[:, 5:].reshape(-1, n, 3) * (high - low))

    def act(self, sim: Sim, was: Snapshot, action: Float[np.ndarray, "B N A"]) -> None:
        """Thrust along the world's axes."""
        sim.control[:] = action.reshape(len(action), -1)

    def read(self, sim: Sim, rows: Rows = EVERY) -> Snapshot:
        """Positions do not lag behind the physics: they are generalised coordinates."""
        position, velocity = drones.kinematics(sim, self.spec.num_agents, rows)
        marker = sim.marker[rows].T.copy()
        terminal, health = marker[:, :_HAZARD].copy(), sim.field["health"][rows].copy()
        apart, away = coverage.apart(position), coverage.distances(terminal, position)
        return Snapshot(
            threads=sim.threads,
            position=position,
            velocity=velocity,
            health=health,
            terminal=terminal,
            hazard=marker[:, _HAZARD:],
            apart=apart,
            away=away,
            hops=self._hops(apart, away, health),
        )

    def renew(self, sim: Sim, now: Snapshot, ids: Int[np.ndarray, "n"], fresh: Snapshot) -> Snapshot:
        """Put the fresh worlds into the arrays of the others."""
        drones.replace(now, ids, fresh)
        return now

    def harm(self, was: Snapshot, now: Snapshot) -> Harm:
        """Exposure from the hazard."""
        (distance,) = coverage.distances(now.hazard, now.position)
        risk = hazards.risk(distance, self.params.hazard_radius, self.params.hazard_peak)
        exposure = health.hazard_rate(risk, self.spec.control_step / 0.1).T.copy()
        nobody = np.zeros(exposure.shape, bool)
        return Harm(exposure, fatal=nobody, cause=np.zeros(exposure.shape, np.int64))

    def remember(self, sim: Sim, was: Snapshot, now: Snapshot) -> Snapshot:
        """Count connected steps, when the first came, and how long the chains were."""
        (bereft,) = (now.health != was.health).any(axis=1).nonzero()
        if len(bereft):
            now.hops[..., bereft] = self._hops(
                now.apart[..., bereft], now.away[..., bereft], now.health[bereft]
            )
        chain = now.hops[_A, _B]
        connected = chain > 0
        field = sim.field
        first = connected & (field["connected"][:, 0] == 0)
        field["first_link"][first] = field["elapsed"][first]
        field["connected"][:, 0] += connected
        field["chain"][:, 0] += np.where(connected, chain - 1, 0)
        return now

    def reward(self, was: Snapshot, now: Snapshot) -> dict[str, Float[np.ndarray, "B"]]:
        """``connected``: 1 while a chain of live drones links the terminals."""
        return {"connected": (now.hops[_A, _B] > 0).astype(np.float64)}

    def terminated(self, now: Snapshot) -> tuple[Bool[np.ndarray, "B"], str]:
        """Never before the horizon."""
        return np.zeros(len(now.health), bool), ""

    def observe(self, now: Snapshot) -> Float[np.ndarray, "n N O"]:
        """Own motion exactly, both terminals, own routes, nearby live drones and nearby wrecks."""
        start = {name: columns.start for name, columns in self.layout.observation.slices.items()}
        seen = np.empty((*now.health.shape, self.layout.observation.size), np.float32)

        def see(part: slice) -> None:
            worlds = part.start, part.stop
            sensing.write_own(*worlds, now.health, now.velocity, now.position, seen)
            sensing.write_routes(
                *worlds, now.terminal, now.hops, now.position, seen, start["terminal_position"]
            )
            sensing.write_team(
                *worlds, now.apart, self.params.sensing_radius, now.health, now.velocity, now.position,
                seen, start["neighbor_seen"], self._slots, self._wrecks,
            )  # fmt: skip

        on_threads(see, len(seen), now.threads)
        return seen

    def state(self, now: Snapshot) -> Float[np.ndarray, "n S"]:
        """Everything, the hidden hazard included."""
        return drones.pack(
            self.layout.state,
            {
                "health": now.health.T,
                "position": now.position.swapaxes(0, 1),
                "velocity": now.velocity.swapaxes(0, 1),
                "route": now.hops[:, 2:].swapaxes(0, 1) >= 0,
                "terminal_position": now.terminal.swapaxes(0, 1),
                "hazard_position": now.hazard[:, 0],
            },
            now.health.shape[:1],
        )

    def measure(
        self, sim: Sim, ids: Int[np.ndarray, "n"], now: Snapshot
    ) -> dict[str, Float[np.ndarray, "n"]]:
        """Share of connected steps, step of the first link, mean relays in the shortest chain."""
        field = sim.field
        linked = field["connected"][ids, 0]
        ever = linked > 0
        return {
            "connected": linked / field["elapsed"][ids, 0],
            "first_link": np.where(ever, field["first_link"][ids, 0], np.nan),
            "chain": np.where(ever, field["chain"][ids, 0] / np.maximum(linked, 1), np.nan),
        }

    def _hops(
        self,
        apart: Float[np.ndarray, "N N B"],
        away: Float[np.ndarray, "2 N B"],
        health: Float[np.ndarray, "B N"],
    ) -> Int8[np.ndarray, "2 N+2 B"]:
        """Links from each terminal to each node, over live drones; the terminals never hear each other."""
        nodes, reach, live = len(apart) + 2, self.params.link_range, drones.living(health)
        links = np.zeros((nodes, nodes, len(health)), bool)
        links[2:, 2:] = (apart < reach) & live[:, None] & live
        links[:2, 2:] = (away < reach) & live
        links[2:, :2] = links[:2, 2:].swapaxes(0, 1)
        return radio.hops(links, (_A, _B))
