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
from hipg_bench.families.family import EVERY, Harm, Rows
from hipg_bench.families.scene import add_marker
from hipg_bench.layout import Block, Layout, TaskLayout
from hipg_bench.mechanics import radio
from hipg_bench.mechanics.pairs import Gaps, between_agents, of_both, table, to_points
from hipg_bench.sim import Sim
from hipg_bench.spec import TaskSpec, parse

_MARKERS = (("terminal0", "terminal.xml"), ("terminal1", "terminal.xml"), ("hazard", "hazard.xml"))
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


@dataclasses.dataclass(frozen=True)
class Snapshot:
    """The world at the end of a control step."""

    position: Float[np.ndarray, "B N 2"]  # m
    velocity: Float[np.ndarray, "B N 2"]  # m/s; of the dead, the one they died with
    health: Float[np.ndarray, "B N"]
    marker: Float[np.ndarray, "B 3 2"]  # the two terminals, the hazard, m
    connected: Bool[np.ndarray, "B"]  # at the end of the last step
    away: Gaps  # agents to terminals and hazard
    apart: Gaps  # agents to agents
    past: particles.Past | None  # with the histogram observation
    look: Float[np.ndarray, "B N K"] | None = None  # this step's part of the histogram observation
    past_look: Float[np.ndarray, "B N K"] | None = None  # the previous step's; both counted once only


class PaperComm:
    """Rules of the paper's communication; see `hipg_bench.families.family.Family` for each method."""

    causes: tuple[str, ...] = particles.CAUSES
    metrics: tuple[str, ...] = ("connected", "collisions", *particles.DEATH_METRICS)
    physics_steps: int = 1

    def __init__(self, spec: TaskSpec) -> None:
        self.spec = spec
        self.params = params = parse(Params, spec.params, spec.task)
        n = spec.num_agents
        self.link_range = params.link_scale * n**params.link_power + params.link_offset
        self.fields: Mapping[str, int] = {
            "connected": 1, "connected_steps": 1, "collisions": 1, **particles.memory(params, n),
        }  # fmt: skip
        self.chance_size = 2 + 2 * n
        terminals = Block("terminal_position", (2, 2), "m", "world")
        self._look_layout = Layout((*particles.own_blocks(), terminals, *particles.around_blocks()))
        self.layout = TaskLayout(
            observation=self._direct_layout() if self._direct else particles.two_steps(self._look_layout),
            action=particles.ACTION,
            state=Layout((
                Block("terminated", (n,), "1"),
                Block("position", (n, 2), "m", "world"),
                Block("velocity", (n, 2), "m/s", "world"),
                terminals,
                Block("hazard_position", (2,), "m", "world"),
                Block("marker_hazardous", (3,), "1", "-", "terminals 0, hazard 1"),
                Block("marker_velocity", (3, 2), "m/s", "world", "never: they stand still"),
            )),
            health_block="terminated",
            dead_value=1.0,
        )  # fmt: skip

    def scene(self) -> mujoco.MjSpec:
        """N particles; terminals and hazard are mocap bodies, so that they are part of the row."""
        scene = particles.scene(self.spec, self.params, self.params.agent_radius)
        for name, kind in _MARKERS:
            add_marker(scene, name, kind).pos[2] = particles.HEIGHT
        return scene

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

    def act(self, sim: Sim, was: Snapshot, action: Float[np.ndarray, "B N A"]) -> None:
        """Force along the world's axes."""
        particles.act(sim, self.params, self.params.agent_radius, action)

    def read(self, sim: Sim, rows: Rows = EVERY) -> Snapshot:
        """Positions do not lag behind the physics: they are generalised coordinates."""
        n = self.spec.num_agents
        position, velocity = particles.kinematics(sim, n, rows)
        marker = sim.marker[rows][..., :2].copy()
        return Snapshot(
            position=position,
            velocity=velocity,
            health=sim.field["health"][rows].copy(),
            marker=marker,
            connected=sim.field["connected"][rows, 0] > 0,
            away=to_points(position, marker),
            apart=between_agents(position),
            past=None if self._direct else particles.past(sim, n, rows),
        )

    def harm(self, was: Snapshot, now: Snapshot) -> Harm:
        """Exposure from the hazard, and from every contact."""
        hazardous = np.ones((len(now.health), 1), bool)
        burn = particles.burn(self.params, now.away.distance[_HAZARD:], hazardous, self.spec.control_step)
        return particles.harm(self.params, burn, self._touching(now), was.health > 0)

    def remember(self, sim: Sim, was: Snapshot, now: Snapshot) -> Snapshot:
        """Whether the living link the terminals, and what outlives the step."""
        field = sim.field
        now = dataclasses.replace(now, connected=self._connected(now))
        field["connected"][:, 0] = now.connected
        field["connected_steps"][:, 0] += now.connected
        one, other = of_both(was.health > 0)
        field["collisions"][:, 0] += (self._touching(now) & one & other).sum(axis=0)
        particles.remember(sim, was, now, past=not self._direct)
        if self._direct:
            return now
        past_look = self._look(was) if was.look is None else was.look
        return dataclasses.replace(now, look=self._look(now), past_look=past_look)

    def reward(self, was: Snapshot, now: Snapshot) -> dict[str, Float[np.ndarray, "B"]]:
        """``connected``: N while the terminals are linked, the reward R that every agent receives."""
        return {"connected": self.spec.num_agents * now.connected.astype(np.float64)}

    def terminated(self, now: Snapshot) -> tuple[Bool[np.ndarray, "B"], str]:
        """Never: the dead stay, and so does the horizon."""
        return np.zeros(len(now.health), bool), ""

    def observe(self, now: Snapshot) -> Float[np.ndarray, "n N O"]:
        """Terminals, and other agents listed or counted; never the hazard."""
        if self._direct:
            return self._list(now)
        look = self._look(now) if now.look is None else now.look
        past_look = self._look_back(now) if now.past_look is None else now.past_look
        return np.concatenate([look, past_look], axis=-1)

    def state(self, now: Snapshot) -> Float[np.ndarray, "n S"]:
        """Five numbers per agent, terminal and hazard: place, velocity, and dead or hazardous."""
        return self.layout.state.pack(
            {
                "terminated": now.health == 0,
                "position": now.position,
                "velocity": now.velocity,
                "terminal_position": now.marker[:, :_HAZARD],
                "hazard_position": now.marker[:, _HAZARD],
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

    @property
    def _direct(self) -> bool:
        return self.params.observation == "direct"

    def _direct_layout(self) -> Layout:
        others, heard = (self.spec.num_agents - 1,), f"alive and within {self.link_range:.4g} m"
        return Layout((
            *particles.own_blocks(),
            Block("terminal_position", (2, 2), "m", "world"),
            Block("other_terminated", others, "1", "-", f"{heard}, so that it is 0: the dead are silent"),
            Block("other_position", (*others, 2), "m", "own", heard),
            Block("other_velocity", (*others, 2), "m/s", "own", heard),
        ))  # fmt: skip

    def _list(self, now: Snapshot) -> Float[np.ndarray, "n N O"]:
        """The direct observation: what the others within range say."""
        heard = particles.others(np.ascontiguousarray(np.moveaxis(self._links(now), -1, 0)))
        return self.layout.observation.pack(
            {
                "terminated": (now.health == 0)[..., None],
                "velocity": now.velocity,
                "position": now.position,
                "terminal_position": now.marker[:, None, :_HAZARD],
                "other_terminated": np.zeros(1),
                "other_position": particles.relative(now.position, heard),
                "other_velocity": particles.relative(now.velocity, heard),
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
                "terminal_position": now.marker[:, None, :_HAZARD],
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
            apart=between_agents(past.position),
        )
        return np.where(past.exists[:, None, None], self._look(before), np.float32(0))

    def _touching(self, now: Snapshot) -> Bool[np.ndarray, "P B"]:
        return particles.touching(now.apart, self.params.agent_radius)

    def _links(self, now: Snapshot) -> Bool[np.ndarray, "N N B"]:
        """Live agents that hear each other."""
        one, other = of_both(now.health > 0)
        return table((now.apart.distance <= self.link_range) & one & other, self.spec.num_agents)

    def _connected(self, now: Snapshot) -> Bool[np.ndarray, "B"]:
        """Whether live agents link the terminals; terminals do not hear each other."""
        n = self.spec.num_agents
        heard = (now.away.distance[:_HAZARD] <= self.link_range) & (now.health.T > 0)
        links = np.zeros((n + 2, n + 2, len(now.health)), bool)
        links[2:, 2:] = self._links(now)
        links[:2, 2:] = heard
        links[2:, :2] = heard.transpose(1, 0, 2)
        return radio.reachable(np.moveaxis(links, -1, 0), 0)[:, 1]
