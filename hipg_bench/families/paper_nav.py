"""The paper's hazardous navigation: N particles cover N landmarks; one more landmark kills.

Who: N particles anywhere in a square, with N safe landmarks and a few hazardous ones. What pays: an
agent near every safe landmark. What hurts: a hazardous landmark looks like the others until any agent
first comes within its radius; death grows likelier towards its centre. Overlapping costs, but does
not kill. When it ends: at the horizon. With no hazards it is the paper's cooperative navigation.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import mujoco
import numpy as np
import pydantic
from jaxtyping import Bool, Float, Int

from hipg_bench.families import paper_particles as particles
from hipg_bench.families.family import EVERY, Harm, Rows
from hipg_bench.families.scene import add_marker
from hipg_bench.layout import Block, Layout, TaskLayout
from hipg_bench.mechanics.pairs import Gaps, between_agents, of_both, to_points
from hipg_bench.sim import Sim
from hipg_bench.spec import TaskSpec, parse


class Params(particles.ParticleParams):
    """Numbers of the paper's navigation.

    Attributes:
        agent_radius: in a team of three, m; a larger team's agents shrink so that their area stays.
        hazards: how many landmarks are hazardous, beside the N safe ones.
        dead_cover: whether a dead agent still covers landmarks, as in the authors' code.
        nobody: distance charged for a landmark where only the living cover and nobody lives, m.
    """

    agent_radius: float = pydantic.Field(gt=0, le=1)
    hazards: int = pydantic.Field(ge=0, le=8)
    dead_cover: bool
    nobody: float = pydantic.Field(gt=0, le=20)


@dataclasses.dataclass(frozen=True)
class Snapshot:
    """The world at the end of a control step."""

    position: Float[np.ndarray, "B N 2"]  # m
    velocity: Float[np.ndarray, "B N 2"]  # m/s; of the dead, the one they died with
    health: Float[np.ndarray, "B N"]
    point: Float[np.ndarray, "B L 2"]  # m
    hazardous: Bool[np.ndarray, "B L"]
    revealed: Bool[np.ndarray, "B L"]  # hazardous, and known to be
    away: Gaps  # agents to landmarks
    apart: Gaps  # agents to agents
    past: particles.Past | None  # with the histogram observation
    past_revealed: Bool[np.ndarray, "B L"]
    look: Float[np.ndarray, "B N K"] | None = None  # this step's part of the histogram observation
    past_look: Float[np.ndarray, "B N K"] | None = None  # the previous step's; both counted once only


class PaperNav:
    """Rules of the paper's navigation; see `hipg_bench.families.family.Family` for each method."""

    causes: tuple[str, ...] = particles.CAUSES
    metrics: tuple[str, ...] = ("covered", "collisions", *particles.DEATH_METRICS)
    physics_steps: int = 1

    def __init__(self, spec: TaskSpec) -> None:
        self.spec = spec
        self.params = params = parse(Params, spec.params, spec.task)
        n = spec.num_agents
        self.radius = params.agent_radius * (3 / n) ** 0.5
        self._points = points = n + params.hazards
        self.fields: Mapping[str, int] = {
            "hazardous": points, "revealed": points, "past_revealed": points, "collisions": 1, "covered": 1,
            **particles.memory(params, n),
        }  # fmt: skip
        self.chance_size = 2 * n + 3 * points
        self._look_layout = Layout((
            *particles.own_blocks(),
            Block("point_count", particles.CELLS, "landmarks", "own", f"{particles.IN_RANGE}, unrevealed"),
            Block("hazard_position", (2,), "m", "own", "nearest revealed hazard, at any distance"),
            *particles.around_blocks(),
        ))  # fmt: skip
        self.layout = TaskLayout(
            observation=self._direct_layout() if self._direct else particles.two_steps(self._look_layout),
            action=particles.ACTION,
            state=Layout((
                Block("terminated", (n,), "1"),
                Block("position", (n, 2), "m", "world"),
                Block("velocity", (n, 2), "m/s", "world"),
                Block("point_hazardous", (points,), "1"),
                Block("point_position", (points, 2), "m", "world"),
                Block("point_velocity", (points, 2), "m/s", "world", "never: landmarks stand still"),
            )),
            health_block="terminated",
            dead_value=1.0,
        )  # fmt: skip

    def scene(self) -> mujoco.MjSpec:
        """N particles and all landmarks; these are mocap bodies, so that they are part of the row."""
        scene = particles.scene(self.spec, self.params, self.radius)
        for i in range(self._points):
            add_marker(scene, f"point{i}", "point.xml").pos[2] = particles.HEIGHT
        return scene

    def reset(self, sim: Sim, ids: Int[np.ndarray, "n"], chance: Float[np.ndarray, "n K"]) -> None:
        """Everything uniform in the square; which landmarks are hazardous is drawn too."""
        n, points, half = self.spec.num_agents, self._points, self.params.half_width
        start, where, rank = np.split(chance, [2 * n, 2 * (n + points)], axis=1)
        particles.place(sim, ids, start, half)
        sim.marker[ids, :, :2] = (half * (2 * where - 1)).reshape(-1, points, 2)
        sim.field["hazardous"][ids] = rank.argsort(axis=1) < self.params.hazards
        sim.field["revealed"][ids] = self._found(self.read(sim, ids))

    def act(self, sim: Sim, was: Snapshot, action: Float[np.ndarray, "B N A"]) -> None:
        """Force along the world's axes."""
        particles.act(sim, self.params, self.radius, action)

    def read(self, sim: Sim, rows: Rows = EVERY) -> Snapshot:
        """Positions do not lag behind the physics: they are generalised coordinates."""
        n = self.spec.num_agents
        position, velocity = particles.kinematics(sim, n, rows)
        point = sim.marker[rows][..., :2].copy()
        return Snapshot(
            position=position,
            velocity=velocity,
            health=sim.field["health"][rows].copy(),
            point=point,
            hazardous=sim.field["hazardous"][rows] > 0,
            revealed=sim.field["revealed"][rows] > 0,
            away=to_points(position, point),
            apart=between_agents(position),
            past=None if self._direct else particles.past(sim, n, rows),
            past_revealed=sim.field["past_revealed"][rows] > 0,
        )

    def harm(self, was: Snapshot, now: Snapshot) -> Harm:
        """Exposure from every hazardous landmark within reach, and from contacts where the spec says so."""
        burn = particles.burn(self.params, now.away.distance, now.hazardous, self.spec.control_step)
        return particles.harm(self.params, burn, particles.touching(now.apart, self.radius), was.health > 0)

    def remember(self, sim: Sim, was: Snapshot, now: Snapshot) -> Snapshot:
        """A hazard is revealed for good once an agent, dead or alive, is within its radius."""
        field = sim.field
        now = dataclasses.replace(now, revealed=was.revealed | self._found(now), past_revealed=was.revealed)
        field["revealed"][:] = now.revealed
        field["past_revealed"][:] = was.revealed
        field["collisions"][:, 0] += self._overlaps(now)[0]
        field["covered"][:, 0] += self._gap(now)
        particles.remember(sim, was, now, past=not self._direct)
        if self._direct:
            return now
        past_look = self._look(was) if was.look is None else was.look
        return dataclasses.replace(now, look=self._look(now), past_look=past_look)

    def reward(self, was: Snapshot, now: Snapshot) -> dict[str, Float[np.ndarray, "B"]]:
        """Parts of the reward R that every agent receives.

        ``distance``: each agent is charged for all safe landmarks, m; ``collision``: pairs of live agents
        that overlap, of which each is charged; ``dead_overlap``: live agents on dead ones.
        """
        collision, dead_overlap = self._overlaps(now)
        distance = self.spec.num_agents * self._gap(now)
        return {"distance": distance, "collision": collision, "dead_overlap": dead_overlap}

    def terminated(self, now: Snapshot) -> tuple[Bool[np.ndarray, "B"], str]:
        """Never: dying must not save a team from being charged."""
        return np.zeros(len(now.health), bool), ""

    def observe(self, now: Snapshot) -> Float[np.ndarray, "n N O"]:
        """Landmarks and other agents, listed or counted; sensing has no range limit."""
        if self._direct:
            return self._list(now)
        look = self._look(now) if now.look is None else now.look
        past_look = self._look_back(now) if now.past_look is None else now.past_look
        return np.concatenate([look, past_look], axis=-1)

    def state(self, now: Snapshot) -> Float[np.ndarray, "n S"]:
        """Five numbers per agent and landmark: place, velocity, and dead or hazardous."""
        return self.layout.state.pack(
            {
                "terminated": now.health == 0,
                "position": now.position,
                "velocity": now.velocity,
                "point_hazardous": now.hazardous,
                "point_position": now.point,
                "point_velocity": np.zeros(2),
            },
            now.health.shape[:1],
        )

    def measure(
        self, sim: Sim, ids: Int[np.ndarray, "n"], now: Snapshot
    ) -> dict[str, Float[np.ndarray, "n"]]:
        """``covered``: sum over safe landmarks of the distance to the nearest agent, mean over steps, m."""
        return {
            "covered": sim.field["covered"][ids, 0] / sim.field["elapsed"][ids, 0],
            "collisions": sim.field["collisions"][ids, 0],
            **particles.deaths_by_cause(sim, ids),
        }

    @property
    def _direct(self) -> bool:
        return self.params.observation == "direct"

    def _direct_layout(self) -> Layout:
        others = (self.spec.num_agents - 1,)
        return Layout((
            *particles.own_blocks(),
            Block("point_position", (self._points, 2), "m", "own"),
            Block("point_revealed", (self._points,), "1", "-", "1 on hazards that an agent came upon"),
            Block("other_terminated", others, "1", "-", "1 once dead"),
            Block("other_position", (*others, 2), "m", "own", "while that agent lives"),
            Block("other_velocity", (*others, 2), "m/s", "own", "while that agent lives"),
        ))  # fmt: skip

    def _list(self, now: Snapshot) -> Float[np.ndarray, "n N O"]:
        """The direct observation."""
        dead = now.health == 0
        n = self.spec.num_agents
        gone = particles.others(np.broadcast_to(dead[:, None], (len(dead), n, n)))
        return self.layout.observation.pack(
            {
                "terminated": dead[..., None],
                "velocity": now.velocity,
                "position": now.position,
                "point_position": now.point[:, None] - now.position[:, :, None],
                "point_revealed": now.revealed[:, None],
                "other_terminated": gone,
                "other_position": particles.relative(now.position, ~gone),
                "other_velocity": particles.relative(now.velocity, ~gone),
            },
            now.health.shape,
        )

    def _look(self, now: Snapshot) -> Float[np.ndarray, "n N K"]:
        """One control step's part of the histogram observation."""
        dead = now.health == 0
        return self._look_layout.pack(
            {
                "terminated": dead[..., None],
                "velocity": now.velocity,
                "position": now.position,
                "point_count": particles.points_around(now.away, ~now.revealed.T),
                "hazard_position": self._nearest_revealed(now),
                "other_count": particles.agents_around(now.apart, ~dead),
                "dead_position": particles.nearest_dead(now.position, dead),
            },
            now.health.shape,
        )

    def _look_back(self, now: Snapshot) -> Float[np.ndarray, "n N K"]:
        """The previous control step's part, from what the rows remember of it; zeros at first."""
        past = now.past
        if past is None:
            raise ValueError("a direct observation does not look back")
        before = dataclasses.replace(
            now,
            position=past.position,
            velocity=past.velocity,
            health=past.health,
            revealed=now.past_revealed,
            away=to_points(past.position, now.point),
            apart=between_agents(past.position),
        )
        return np.where(past.exists[:, None, None], self._look(before), np.float32(0))

    def _nearest_revealed(self, now: Snapshot) -> Float[np.ndarray, "n N 2"]:
        """Relative position of the nearest revealed hazard, m; zeros before one is known."""
        found = np.zeros_like(now.position)
        ids = np.flatnonzero(now.revealed.any(axis=1))
        distance = np.where(now.revealed[ids].T[:, None], now.away.distance[..., ids], np.inf)
        found[ids] = now.point[ids[:, None], distance.argmin(axis=0).T] - now.position[ids]
        return found

    def _found(self, now: Snapshot) -> Bool[np.ndarray, "n L"]:
        """Hazards with an agent, dead or alive, within their radius."""
        return now.hazardous & (now.away.distance < self.params.hazard_radius).any(axis=1).T

    def _gap(self, now: Snapshot) -> Float[np.ndarray, "B"]:
        """Sum over safe landmarks of the distance to the nearest agent that covers, m."""
        distance = now.away.distance
        if not self.params.dead_cover:
            distance = np.where(now.health.T > 0, distance, np.inf)
        nearest = distance.min(axis=1)
        nearest = np.where(np.isinf(nearest), self.params.nobody, nearest)
        charged = np.where(now.hazardous.T, 0.0, nearest)
        # one after the other: the order in which np.sum adds depends on the number of worlds
        return np.add.accumulate(charged, axis=0)[-1]

    def _overlaps(self, now: Snapshot) -> tuple[Float[np.ndarray, "B"], Float[np.ndarray, "B"]]:
        """Overlapping pairs of which both live, and of which one does."""
        touch = particles.touching(now.apart, self.radius)
        one, other = of_both(now.health > 0)
        both = (touch & one & other).sum(axis=0)
        return both.astype(np.float64), (touch & (one ^ other)).sum(axis=0).astype(np.float64)
