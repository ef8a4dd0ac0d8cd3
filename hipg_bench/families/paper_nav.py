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
from hipg_bench.families import paper_senses as senses
from hipg_bench.families.family import EVERY, Rows
from hipg_bench.layout import SHARE, Block, Layout, TaskLayout
from hipg_bench.mechanics import plane
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


@dataclasses.dataclass(kw_only=True)
class Snapshot(particles.Snapshot):
    """The world at the end of a control step; points are landmarks."""

    hazardous: Bool[np.ndarray, "B L"]
    revealed: Bool[np.ndarray, "B L"]  # hazardous, and known to be
    gap: Float[np.ndarray, "B"]  # sum over safe landmarks to an agent, m; once it is known who died


class PaperNav(particles.Particles[Snapshot]):
    """Rules of the paper's navigation; see `hipg_bench.families.family.Family` for each method."""

    metrics: tuple[str, ...] = ("covered", "collisions", *particles.DEATH_METRICS)

    def __init__(self, spec: TaskSpec) -> None:
        self.params = params = parse(Params, spec.params, spec.task)
        n = spec.num_agents
        super().__init__(spec, params, radius=params.agent_radius * (3 / n) ** 0.5)
        self._points = points = n + params.hazards
        self.fields: Mapping[str, int] = {
            "hazardous": points, "revealed": points, "past_revealed": points, "collisions": 1, "covered": 1,
            **self._memory,
        }  # fmt: skip
        self.chance_size = 2 * n + 3 * points
        self._look_layout = Layout((
            *senses.own_blocks(),
            Block("point_count", senses.CELLS, "landmarks", "own", f"{senses.IN_RANGE}, unrevealed"),
            Block("hazard_position", (2,), "m", "own", "nearest revealed hazard, at any distance"),
            *senses.around_blocks(),
        ))  # fmt: skip
        self.layout = TaskLayout(
            observation=self._direct_layout() if self._direct else senses.two_steps(self._look_layout),
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

    def scene(self) -> mujoco.MjSpec:
        """N particles and all landmarks."""
        points = {f"point{i}": "point.xml" for i in range(self._points)}
        return particles.scene(self.spec, self.params, self.radius, points)

    def reset(self, sim: Sim, ids: Int[np.ndarray, "n"], chance: Float[np.ndarray, "n K"]) -> None:
        """Everything uniform in the square; which landmarks are hazardous is drawn too."""
        n, points, half = self.spec.num_agents, self._points, self.params.half_width
        start, where, rank = np.split(chance, [2 * n, 2 * (n + points)], axis=1)
        particles.place(sim, ids, start, half)
        sim.marker[ids, :, :2] = (half * (2 * where - 1)).reshape(-1, points, 2)
        sim.field["hazardous"][ids] = rank.argsort(axis=1) < self.params.hazards
        world, _, point = self.read(sim, ids).exposed
        sim.field["revealed"][ids[world], point] = 1

    def read(self, sim: Sim, rows: Rows = EVERY) -> Snapshot:
        """Positions do not lag behind the physics: they are generalised coordinates."""
        hazardous = sim.field["hazardous"][rows] > 0
        return Snapshot(
            hazardous=hazardous,
            revealed=sim.field["revealed"][rows] > 0,
            gap=np.zeros(len(hazardous)),
            **self._bodies(sim, rows, hazardous),
        )

    def remember(self, sim: Sim, was: Snapshot, now: Snapshot) -> Snapshot:
        """A hazard is revealed for good once an agent, dead or alive, is within its radius."""
        world, _, point = now.exposed
        now.revealed[world, point] = True
        alive = now.health > 0
        self._count_overlaps(now, alive)
        covers = np.ones_like(alive) if self.params.dead_cover else alive
        plane.sum_gaps(now.position, covers, now.point, ~now.hazardous, self.params.nobody, now.gap)
        field = sim.field
        field["revealed"][:] = now.revealed
        field["past_revealed"][:] = was.revealed
        field["collisions"][:, 0] += now.overlaps[:, 0]
        field["covered"][:, 0] += now.gap
        self._keep(sim, was, now)
        return now

    def reward(self, was: Snapshot, now: Snapshot) -> dict[str, Float[np.ndarray, "B"]]:
        """Parts of the reward R that every agent receives.

        ``distance``: each agent is charged for all safe landmarks, m; ``collision``: pairs of live agents
        that overlap, of which each is charged; ``dead_overlap``: live agents on dead ones.
        """
        collision, dead_overlap = now.overlaps.T
        return {
            "distance": self.spec.num_agents * now.gap, "collision": collision, "dead_overlap": dead_overlap,
        }  # fmt: skip

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

    def _direct_layout(self) -> Layout:
        others = (self.spec.num_agents - 1,)
        return Layout((
            *senses.own_blocks(),
            Block("point_position", (self._points, 2), "m", "own"),
            Block("point_revealed", (self._points,), "1", "-",
                  "1 on hazards that an agent came upon", limits=SHARE),
            Block("other_terminated", others, "1", "-", "1 once dead", limits=SHARE),
            Block("other_position", (*others, 2), "m", "own", "while that agent lives"),
            Block("other_velocity", (*others, 2), "m/s", "own", "while that agent lives"),
        ))  # fmt: skip

    def _list(self, now: Snapshot) -> Float[np.ndarray, "n N O"]:
        """The direct observation."""
        dead = now.health == 0
        n = self.spec.num_agents
        gone = senses.others(np.broadcast_to(dead[:, None], (len(dead), n, n)))
        return self.layout.observation.pack(
            {
                "terminated": dead[..., None],
                "velocity": now.velocity,
                "position": now.position,
                "point_position": now.point[:, None] - now.position[:, :, None],
                "point_revealed": now.revealed[:, None],
                "other_terminated": gone,
                "other_position": senses.relative(now.position, ~gone),
                "other_velocity": senses.relative(now.velocity, ~gone),
            },
            now.health.shape,
        )

    def _hints(self, now: Snapshot) -> senses.Hints:
        nothing = np.empty((len(now.health), 0))
        return senses.Hints(told=nothing, shown=~now.revealed, known=now.revealed)

    def _before(self, now: Snapshot) -> Snapshot:
        revealed = now.sim.field["past_revealed"][now.rows] > 0
        return dataclasses.replace(super()._before(now), revealed=revealed)
