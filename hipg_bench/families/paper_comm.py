"""The paper's hazardous communication: a chain of N particles links two terminals, past a hidden killer.

Who: N small particles anywhere in a square, with two terminals on opposite sides and a hazard on the
line between them. What pays: every step in which live agents link the terminals; a partial chain pays
nothing. What hurts: the hazard, which nobody ever sees, and touching one another. The dead do not
relay; their places are the only hint of the hazard. When it ends: at the horizon.
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
from hipg_bench.mechanics import looks, plane
from hipg_bench.sim import Sim
from hipg_bench.spec import TaskSpec, parse

_MARKERS = {"terminal0": "terminal.xml", "terminal1": "terminal.xml", "hazard": "hazard.xml"}
_HAZARD = 2


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


@dataclasses.dataclass(kw_only=True)
class Snapshot(particles.Snapshot):
    """The world at the end of a control step; points are the two terminals and the hazard."""

    connected: Bool[np.ndarray, "B"]  # at the end of the last step, until it is known who died


class PaperComm(particles.Particles[Snapshot]):
    """Rules of the paper's communication; see `hipg_bench.families.family.Family` for each method."""

    live_dead_look: int = looks.NO_AGENTS  # the dead hear nobody
    metrics: tuple[str, ...] = ("connected", "collisions", *particles.DEATH_METRICS)

    def __init__(self, spec: TaskSpec) -> None:
        self.params = params = parse(Params, spec.params, spec.task)
        super().__init__(spec, params, radius=params.agent_radius)
        n = spec.num_agents
        self.link_range = params.link_scale * n**params.link_power + params.link_offset
        self.fields: Mapping[str, int] = {
            "connected": 1, "connected_steps": 1, "collisions": 1, **self._memory,
        }  # fmt: skip
        self.chance_size = 2 + 2 * n
        terminals = Block("terminal_position", (2, 2), "m", "world")
        self._look_layout = Layout((*senses.own_blocks(), terminals, *senses.around_blocks()))
        self.layout = TaskLayout(
            observation=self._direct_layout() if self._direct else senses.two_steps(self._look_layout),
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

    def scene(self) -> mujoco.MjSpec:
        """N particles, terminals and hazard."""
        return particles.scene(self.spec, self.params, self.radius, _MARKERS)

    def reset(self, sim: Sim, ids: Int[np.ndarray, "n"], chance: Float[np.ndarray, "n K"]) -> None:
        """Turn the terminals' line, hide the hazard on it, scatter the agents."""
        params = self.params
        angle = 2 * np.pi * chance[:, :1]
        line = np.concatenate([np.cos(angle), np.sin(angle)], axis=1)
        end = params.terminal_gap / 2 * line
        hazard = params.hazard_along * (2 * chance[:, 1:2] - 1) * line
        sim.marker[ids, :, :2] = np.stack([-end, end, hazard], axis=1)
        particles.place(sim, ids, chance[:, 2:], params.half_width)
        # those who stand well at the start are linked before the first step
        sim.field["connected"][ids, 0] = self._connected(self.read(sim, ids))

    def read(self, sim: Sim, rows: Rows = EVERY) -> Snapshot:
        """Positions do not lag behind the physics: they are generalised coordinates."""
        connected = sim.field["connected"][rows, 0] > 0
        hazardous = np.broadcast_to(np.arange(3) == _HAZARD, (len(connected), 3))
        return Snapshot(connected=connected, **self._bodies(sim, rows, hazardous))

    def remember(self, sim: Sim, was: Snapshot, now: Snapshot) -> Snapshot:
        """Whether the living link the terminals, and what outlives the step."""
        field = sim.field
        now.connected = self._connected(now)
        field["connected"][:, 0] = now.connected
        field["connected_steps"][:, 0] += now.connected
        if not self._law.collision_risk:  # else they are counted already
            alive = was.health > 0
            self._count_overlaps(now, alive)
        field["collisions"][:, 0] += now.overlaps[:, 0]
        self._keep(sim, was, now)
        return now

    def reward(self, was: Snapshot, now: Snapshot) -> dict[str, Float[np.ndarray, "B"]]:
        """``connected``: N while the terminals are linked, the reward R that every agent receives."""
        return {"connected": self.spec.num_agents * now.connected.astype(np.float64)}

    def state(self, now: Snapshot) -> Float[np.ndarray, "n S"]:
        """Five numbers per agent, terminal and hazard: place, velocity, and dead or hazardous."""
        return self.layout.state.pack(
            {
                "terminated": now.health == 0,
                "position": now.position,
                "velocity": now.velocity,
                "terminal_position": now.point[:, :_HAZARD],
                "hazard_position": now.point[:, _HAZARD],
                "marker_hazardous": np.arange(3) == _HAZARD,
                "marker_velocity": np.zeros(2),
            },
            now.health.shape[:1],
        )

    def measure(
        self, sim: Sim, ids: Int[np.ndarray, "n"], now: Snapshot
    ) -> dict[str, Float[np.ndarray, "n"]]:
        """``connected``: share of steps with a chain; ``collisions``: contacts of live pairs, all steps."""
        return {
            "connected": sim.field["connected_steps"][ids, 0] / sim.field["elapsed"][ids, 0],
            "collisions": sim.field["collisions"][ids, 0],
            **particles.deaths_by_cause(sim, ids),
        }

    def _direct_layout(self) -> Layout:
        others, heard = (self.spec.num_agents - 1,), f"alive and within {self.link_range:.4g} m"
        return Layout((
            *senses.own_blocks(),
            Block("terminal_position", (2, 2), "m", "world"),
            Block("other_terminated", others, "1", "-",
                  f"{heard}, so that it is 0: the dead are silent", limits=SHARE),
            Block("other_position", (*others, 2), "m", "own", heard),
            Block("other_velocity", (*others, 2), "m/s", "own", heard),
        ))  # fmt: skip

    def _list(self, now: Snapshot) -> Float[np.ndarray, "n N O"]:
        """The direct observation: what the others within range say."""
        heard = senses.others(self._links(now))
        return self.layout.observation.pack(
            {
                "terminated": (now.health == 0)[..., None],
                "velocity": now.velocity,
                "position": now.position,
                "terminal_position": now.point[:, None, :_HAZARD],
                "other_terminated": np.zeros(1),
                "other_position": senses.relative(now.position, heard),
                "other_velocity": senses.relative(now.velocity, heard),
            },
            now.health.shape,
        )

    def _hints(self, now: Snapshot) -> senses.Hints:
        none = np.zeros((len(now.health), _HAZARD + 1), bool)
        return senses.Hints(told=now.point[:, :_HAZARD].reshape(-1, 4), shown=none, known=none)

    def _links(self, now: Snapshot) -> Bool[np.ndarray, "B N N"]:
        """Live agents that hear each other."""
        gap = now.position[:, None] - now.position[:, :, None]
        alive = now.health > 0
        near = np.sqrt(gap[..., 0] ** 2 + gap[..., 1] ** 2) <= self.link_range
        return near & alive[:, None] & alive[:, :, None]

    def _connected(self, now: Snapshot) -> Bool[np.ndarray, "B"]:
        """Whether live agents link the terminals; terminals do not hear each other."""
        linked, alive, ends = np.empty(len(now.health), bool), now.health > 0, now.point[:, :_HAZARD].copy()
        plane.find_links(now.position, alive, ends, self.link_range, linked)
        return linked
