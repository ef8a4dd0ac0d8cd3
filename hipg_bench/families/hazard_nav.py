"""Hazard navigation: N drones watch N monitor points, some of which kill.

Who: N drones that take off from the ground. What pays: a live drone near every point, all the time.
What hurts: a few points lie in a hazard that looks like any other point until a drone first comes
within its radius; from then on every drone knows it. Death grows likelier towards its centre. A
hazardous point is still worth watching, from its edge. When it ends: at the horizon, never before.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import mujoco
import numpy as np
import pydantic
from jaxtyping import Bool, Float, Int

from hipg_bench.families import drones
from hipg_bench.families.family import EVERY, Harm, Rows
from hipg_bench.families.scene import add_marker
from hipg_bench.layout import SHARE, Block, Layout, TaskLayout
from hipg_bench.mechanics import coverage, hazards, health, sensing
from hipg_bench.mechanics.few import few
from hipg_bench.native import on_threads
from hipg_bench.sim import Sim
from hipg_bench.spec import TaskSpec, parse

_CANDIDATES = 8
"""Layouts of points drawn per episode, of which the most spread one is used."""
_TAKE_OFF = (0.1, 0.25)
"""Height of drones at the start, m."""
_POINT_HEIGHT = (0.4, 0.9)
"""Height of points, as a share of the ceiling."""


class Params(drones.DroneParams):
    """Numbers of hazard navigation.

    Attributes:
        hazards: how many of the N points are hazardous.
        hazard_radius: beyond it a hazard is harmless, m.
        hazard_peak: chance of death per 0.1 s at its centre.
        nobody: distance that is charged for a point when no drone is nearer or alive, m.
    """

    hazards: int = pydantic.Field(ge=0, le=31)
    hazard_radius: float = pydantic.Field(gt=0, le=5)
    hazard_peak: float = pydantic.Field(ge=0, lt=1)
    nobody: float = pydantic.Field(gt=0, le=20)


@dataclasses.dataclass(kw_only=True)
class Snapshot:
    """The world at the end of a control step; all but health has the worlds last."""

    position: Float[np.ndarray, "3 N B"]  # m
    velocity: Float[np.ndarray, "3 N B"]  # m/s
    health: Float[np.ndarray, "B N"]
    threads: int
    point: Float[np.ndarray, "3 P B"]  # m
    hazardous: Bool[np.ndarray, "P B"]
    revealed: Bool[np.ndarray, "P B"]  # hazardous, and known to be
    distance: Float[np.ndarray, "N P B"]  # drone to point, m
    apart: Float[np.ndarray, "N N B"]  # drone to drone, infinite to oneself, m
    exposed: tuple[Int[np.ndarray, "K"], ...]  # drone, point and world of each drone within a hazard
    # once it is known who died
    gap: Float[np.ndarray, "B"] = dataclasses.field(init=False)  # point to live drone, mean over points, m
    touching: Float[np.ndarray, "B"] = dataclasses.field(init=False)  # pairs of live drones


class HazardNav:
    """Rules of hazard navigation; see `hipg_bench.families.family.Family` for each method."""

    causes: tuple[str, ...] = ("hazard",)
    metrics: tuple[str, ...] = ("covered", "collisions", "revealed")

    def __init__(self, spec: TaskSpec) -> None:
        self.spec = spec
        self.params = params = parse(Params, spec.params, spec.task)
        n = points = spec.num_agents
        self.physics_steps = drones.physics_steps(spec)
        self.fields: Mapping[str, int] = {
            "hazardous": points,
            "revealed": points,
            "collisions": 1,
            "covered": 1,
        }
        self.chance_size = _CANDIDATES * points * 3 + n * 3
        self._slots = min(n - 1, params.neighbors)
        within = f"within {params.sensing_radius:g} m"
        self.layout = TaskLayout(
            observation=Layout((
                Block("health", (1,), "1", limits=SHARE),
                Block("velocity", (3,), "m/s", "world"),
                Block("position", (3,), "m", "world"),
                Block("point_position", (points, 3), "m", "own", "always, nearest point first"),
                Block("point_hazardous", (points,), "1", "-",
                      "once any drone came within its radius", limits=SHARE),
                Block("point_gap", (points,), "m", "-", f"to the nearest other live drone {within}"),
                *drones.neighbor_blocks(self._slots, within),
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

    def scene(self) -> mujoco.MjSpec:
        """N drones and N points; the points are mocap bodies, so that they are part of the row."""
        scene = drones.drone_scene(self.spec, self.params)
        for i in range(self.spec.num_agents):
            add_marker(scene, f"point{i}", "point.xml")
        return scene

    def reset(self, sim: Sim, ids: Int[np.ndarray, "n"], chance: Float[np.ndarray, "n K"]) -> None:
        """Spread the points over the box, the first few of them hazardous; drones start near the ground."""
        n, half = self.spec.num_agents, self.params.half_width
        cut = _CANDIDATES * n * 3
        ceiling = self.params.ceiling
        low, high = (-half, -half, _POINT_HEIGHT[0] * ceiling), (half, half, _POINT_HEIGHT[1] * ceiling)
        sim.marker[ids] = drones.spread(chance[:, :cut].reshape(-1, _CANDIDATES, n, 3), low, high)
        # points are exchangeable, and agents never see their order: the first ones may be the hazards
        sim.field["hazardous"][ids] = np.arange(n) < self.params.hazards
        start = chance[:, cut:].reshape(-1, n, 3)
        low, high = np.array([-half, -half, _TAKE_OFF[0]]), np.array([half, half, _TAKE_OFF[1]])
        drones.place(sim, ids, low + start * (high - low))

    def act(self, sim: Sim, was: Snapshot, action: Float[np.ndarray, "B N A"]) -> None:
        """Thrust along the world's axes."""
        sim.control[:] = action.reshape(len(action), -1)

    def read(self, sim: Sim, rows: Rows = EVERY) -> Snapshot:
        """Positions do not lag behind the physics: they are generalised coordinates."""
        position, velocity = drones.kinematics(sim, self.spec.num_agents, rows)
        point = sim.marker[rows].T.copy()
        hazardous = sim.field["hazardous"][rows].T > 0
        distance = coverage.distances(position, point)
        return Snapshot(
            threads=sim.threads,
            position=position,
            velocity=velocity,
            health=sim.field["health"][rows].copy(),
            point=point,
            hazardous=hazardous,
            revealed=sim.field["revealed"][rows].T.copy() > 0,
            distance=distance,
            apart=coverage.apart(position),
            exposed=few((distance < self.params.hazard_radius) & hazardous),
        )

    def renew(self, sim: Sim, now: Snapshot, ids: Int[np.ndarray, "n"], fresh: Snapshot) -> Snapshot:
        """Put the fresh worlds into the arrays of the others."""
        drones.replace(now, ids, fresh)
        return now

    def harm(self, was: Snapshot, now: Snapshot) -> Harm:
        """Exposure from every hazard within reach."""
        exposure, nobody = np.zeros(now.health.shape), np.zeros(now.health.shape, bool)
        drone, _, world = now.exposed
        if len(world):
            risk = hazards.risk(now.distance[now.exposed], self.params.hazard_radius, self.params.hazard_peak)
            np.add.at(exposure, (world, drone), health.hazard_rate(risk, self.spec.control_step / 0.1))
        return Harm(exposure, fatal=nobody, cause=np.zeros(exposure.shape, np.int64))

    def remember(self, sim: Sim, was: Snapshot, now: Snapshot) -> Snapshot:
        """A hazard is revealed for good once a drone that was alive came within its radius."""
        drone, point, world = now.exposed
        alive = was.health[world, drone] > 0
        now.revealed[point[alive], world[alive]] = True
        live = drones.living(now.health)
        # worlds first: else the order in which NumPy adds would depend on their number
        now.gap = coverage.nearest(now.distance, live, self.params.nobody).T.copy().mean(axis=1)
        now.touching = coverage.contacts(now.apart, live, 2 * self.params.drone_radius)
        sim.field["revealed"][:] = now.revealed.T
        sim.field["collisions"][:, 0] += now.touching
        sim.field["covered"][:, 0] += now.gap
        return now

    def reward(self, was: Snapshot, now: Snapshot) -> dict[str, Float[np.ndarray, "B"]]:
        """``distance``: mean over points to the nearest live drone, m; ``collision``: pairs that touch."""
        return {"distance": now.gap, "collision": now.touching}

    def terminated(self, now: Snapshot) -> tuple[Bool[np.ndarray, "B"], str]:
        """Never: dying must not save a team from being charged."""
        return np.zeros(len(now.health), bool), ""

    def observe(self, now: Snapshot) -> Float[np.ndarray, "n N O"]:
        """Own motion exactly, all points, and the nearest drones within the sensing radius."""
        start = {name: columns.start for name, columns in self.layout.observation.slices.items()}
        seen = np.empty((*now.health.shape, self.layout.observation.size), np.float32)
        radius = self.params.sensing_radius

        def see(part: slice) -> None:
            worlds = part.start, part.stop
            sensing.write_own(*worlds, now.health, now.velocity, now.position, seen)
            sensing.write_points(
                *worlds, now.distance, now.apart, radius, now.health, now.position, now.point, now.revealed,
                seen, start["point_position"],
            )  # fmt: skip
            sensing.write_team(
                *worlds, now.apart, radius, now.health, now.velocity, now.position,
                seen, start["neighbor_seen"], self._slots, 0,
            )  # fmt: skip

        on_threads(see, len(seen), now.threads)
        return seen

    def state(self, now: Snapshot) -> Float[np.ndarray, "n S"]:
        """Everything, the hidden hazards included."""
        return drones.pack(
            self.layout.state,
            {
                "health": now.health.T,
                "position": now.position.swapaxes(0, 1),
                "velocity": now.velocity.swapaxes(0, 1),
                "point_position": now.point.swapaxes(0, 1),
                "point_hazardous": now.hazardous,
                "point_revealed": now.revealed,
            },
            now.health.shape[:1],
        )

    def measure(
        self, sim: Sim, ids: Int[np.ndarray, "n"], now: Snapshot
    ) -> dict[str, Float[np.ndarray, "n"]]:
        """``covered``: mean distance from a point to its nearest live drone over the episode, m."""
        return {
            "covered": sim.field["covered"][ids, 0] / sim.field["elapsed"][ids, 0],
            "collisions": sim.field["collisions"][ids, 0],
            "revealed": sim.field["revealed"][ids].sum(axis=1),
        }
