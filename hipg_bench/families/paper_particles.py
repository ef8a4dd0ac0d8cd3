"""Particles in a plane: body, physics, contacts and deaths that the paper's tasks share.

The numbers and laws are those of the authors' code, see ``docs/paper_suite.md``. One control step is
one physics step: v <- (1 - damping) v + F dt, then x <- x + v dt. MuJoCo's Euler integrator, which
treats joint damping D implicitly, does exactly this for a mass of 1 kg when 1 + dt D = 1 / (1 - damping)
and every force is multiplied by that same factor: v' = (v + dt factor F) / (1 + dt D).
"""

from __future__ import annotations

import abc
import dataclasses
from collections.abc import Mapping
from typing import Any, Generic, Literal, TypeVar

import mujoco
import numpy as np
import pydantic
from jaxtyping import Bool, Float, Float32, Int

from hipg_bench.families import paper_senses as senses
from hipg_bench.families.family import EVERY, Harm, Rows
from hipg_bench.families.scene import add_marker, asset, attach
from hipg_bench.layout import Block, Layout, TaskLayout
from hipg_bench.mechanics import hazards, looks, plane
from hipg_bench.mechanics import health as health_law
from hipg_bench.mechanics.few import few
from hipg_bench.sim import Sim
from hipg_bench.spec import Params, TaskSpec

ACTION = Layout((Block("force", (2,), "N", "world"),))
CAUSES = ("hazard", "collision")
_HAZARD, _COLLISION = range(len(CAUSES))
DEATH_METRICS = tuple(f"deaths_{cause}" for cause in CAUSES)

HEIGHT = 0.03
"""Of points above the floor, so that a camera sees them; the rules know no height, m."""


class ParticleParams(Params):
    """Numbers of a particle and its plane.

    Attributes:
        half_width: agents start in [-half_width, half_width]^2, m; the plane has no walls.
        damping: share of the speed that is lost per control step.
        contact_stiffness: of live agents that overlap, N/m.
        contact_margin: depth over which a contact sets in, m.
        collision_risk: chance that a live agent dies per step of contact with another.
        hazard_radius: beyond it a hazard is harmless, m.
        hazard_peak: chance of death per 0.1 s at its centre.
        observation: ``direct`` (every landmark and agent) or ``histogram`` (of fixed size, two steps).
    """

    half_width: float = pydantic.Field(gt=0, le=10)
    damping: float = pydantic.Field(ge=0, lt=1)
    contact_stiffness: float = pydantic.Field(ge=0, le=1000)
    contact_margin: float = pydantic.Field(gt=0, le=0.1)
    collision_risk: float = pydantic.Field(ge=0, lt=1)
    hazard_radius: float = pydantic.Field(gt=0, le=5)
    hazard_peak: float = pydantic.Field(ge=0, lt=1)
    observation: Literal["direct", "histogram"]


@dataclasses.dataclass(kw_only=True)
class Snapshot:
    """The world at the end of a control step, as far as both families have the same."""

    position: Float[np.ndarray, "B N 2"]  # m
    velocity: Float[np.ndarray, "B N 2"]  # m/s; of the dead, the one they died with
    closest: Float[np.ndarray, "B"]  # squared distance of the two closest agents, m^2
    health: Float[np.ndarray, "B N"]
    point: Float[np.ndarray, "B L 2"]  # landmarks, or terminals and the hazard, m
    exposed: tuple[Int[np.ndarray, "M"], ...]  # world, agent, point: the M cases of an agent in a hazard
    sim: Sim  # from where it was read
    rows: Rows
    overlaps: Float[np.ndarray, "B 2"]  # pairs that overlap, of which both live, and of which one does
    look: Float32[np.ndarray, "B N K"] | None = None  # this step's part of the histogram observation
    past_look: Float32[np.ndarray, "B N K"] | None = None  # the previous step's; both counted once only


S = TypeVar("S", bound=Snapshot)


class Particles(abc.ABC, Generic[S]):
    """Rules that both families share; see `hipg_bench.families.family.Family` for each public method.

    Attributes:
        radius: of an agent, m.
    """

    layout: TaskLayout
    _look_layout: Layout
    causes: tuple[str, ...] = CAUSES
    live_dead_look: int = looks.ALL
    """What the dead see where the task's ``dead_observation`` is ``live``."""
    physics_steps: int = 1

    def __init__(self, spec: TaskSpec, params: ParticleParams, radius: float) -> None:
        self.spec = spec
        self.radius = radius
        self._law = params
        self._direct = params.observation == "direct"
        self._factor = _factor(params)
        n = spec.num_agents
        self._memory = {"velocity": 2 * n}
        if not self._direct:
            self._memory |= {"past_position": 2 * n, "past_velocity": 2 * n, "past_health": n}

    def act(self, sim: Sim, was: S, action: Float[np.ndarray, "B N 2"]) -> None:
        """Push the living, by own force and by contact; the dead stand still at once and touch nobody."""
        alive, law = was.health > 0, self._law
        if not alive.all():
            np.copyto(sim.velocity, 0.0, where=np.repeat(~alive, 2, axis=1))
        sim.control[:] = action.reshape(len(action), -1)
        plane.push_apart(
            was.position, was.closest, alive, 2 * self.radius, law.contact_stiffness, law.contact_margin,
            self._factor, sim.applied,
        )  # fmt: skip

    def renew(self, sim: Sim, now: S, ids: Int[np.ndarray, "n"], fresh: S) -> S:
        """Put the fresh worlds into the arrays of the others."""
        for name, array in vars(now).items():
            if isinstance(array, np.ndarray):
                array[ids] = getattr(fresh, name)
        return now

    def harm(self, was: S, now: S) -> Harm:
        """Exposure from hazards, and from every contact of the living."""
        alive = was.health > 0
        burn, crash = self._burn(now), self._crash(now, alive)
        return Harm(
            burn + crash, np.zeros(alive.shape, bool), cause=np.where(crash > burn, _COLLISION, _HAZARD)
        )

    def terminated(self, now: S) -> tuple[Bool[np.ndarray, "B"], str]:
        """Never: the dead stay, and so does the horizon."""
        return np.zeros(len(now.health), bool), ""

    def observe(self, now: S) -> Float[np.ndarray, "n N O"]:
        """Points and other agents, listed or counted."""
        if self._direct:
            return self._list(now)
        now.look, both = self._see(now, self._look_back(now))
        return both

    @abc.abstractmethod
    def read(self, sim: Sim, rows: Rows = EVERY) -> S:
        """Positions do not lag behind the physics: they are generalised coordinates."""

    @abc.abstractmethod
    def _list(self, now: S) -> Float[np.ndarray, "n N O"]:
        """The direct observation."""

    @abc.abstractmethod
    def _hints(self, now: S) -> senses.Hints:
        """What agents are told and shown in the histogram observation."""

    def _before(self, now: S) -> S:
        """The control step before, as the rows remember it, as far as its part of the observation needs."""
        field, shape = now.sim.field, now.position.shape
        return dataclasses.replace(
            now,
            position=field["past_position"][now.rows].reshape(shape),
            velocity=field["past_velocity"][now.rows].reshape(shape),
            health=field["past_health"][now.rows],
        )

    def _see(self, now: S, past: Float32[np.ndarray, "n N K"]) -> tuple[np.ndarray, np.ndarray]:
        """This step's part of the histogram observation, and the whole of it."""
        dead_look = self.live_dead_look if self.spec.dead_observation == "live" else looks.NOTHING
        return senses.look(self._look_layout, now, self._hints(now), dead_look, past, now.sim.threads)

    def _look_back(self, now: S) -> Float32[np.ndarray, "n N K"]:
        """The previous step's part; where nobody kept it, from what the rows remember; zeros at first."""
        if now.past_look is None:
            begun = now.sim.field["elapsed"][now.rows, 0] > 0
            now.past_look = past = np.zeros((*now.health.shape, self._look_layout.size), np.float32)
            if begun.any():
                past[begun] = self._see(self._before(now), past)[0][begun]
        return now.past_look

    def _bodies(self, sim: Sim, rows: Rows, hazardous: Bool[np.ndarray, "n L"]) -> dict[str, Any]:
        """What all snapshots hold. Positions do not lag behind the physics: they are generalised coordinates.

        Args:
            sim: whose worlds are read.
            rows: which.
            hazardous: points that harm.
        """
        field, health = sim.field, sim.field["health"][rows].copy()
        worlds, agents = health.shape
        position, velocity = np.empty((worlds, agents, 2)), np.empty((worlds, agents, 2))
        point, closest = np.empty((*hazardous.shape, 2)), np.empty(worlds)
        plane.read(
            np.arange(sim.num_envs)[rows], sim.position, sim.velocity, field["health"], field["velocity"],
            sim.marker, position, velocity, point,
        )  # fmt: skip
        plane.find_closest(position, closest)
        exposed = np.empty((worlds, agents, hazardous.shape[1]), bool)
        plane.find_within(position, point, hazardous, self._law.hazard_radius, exposed)
        return {
            "position": position,
            "velocity": velocity,
            "closest": closest,
            "health": health,
            "point": point,
            "exposed": few(exposed),
            "overlaps": np.zeros((worlds, 2)),  # once it is known who lives
            "sim": sim,
            "rows": rows,
        }

    def _keep(self, sim: Sim, was: S, now: S) -> None:
        """Write what outlives the step: the velocity that the dead keep, and the step if it is seen again."""
        field, worlds = sim.field, len(now.health)
        field["velocity"][:] = now.velocity.reshape(worlds, -1)
        if not self._direct:
            field["past_position"][:] = was.position.reshape(worlds, -1)
            field["past_velocity"][:] = was.velocity.reshape(worlds, -1)
            field["past_health"][:] = was.health
            now.past_look = was.look

    def _burn(self, now: S) -> Float[np.ndarray, "B N"]:
        """Exposure of each agent from the hazards it is in, nats."""
        burn, law = np.zeros(now.health.shape), self._law
        world, agent, point = now.exposed
        if len(world):
            gap = now.point[world, point] - now.position[world, agent]
            risk = hazards.risk(np.hypot(*gap.T), law.hazard_radius, law.hazard_peak)
            np.add.at(burn, (world, agent), health_law.hazard_rate(risk, self.spec.control_step / 0.1))
        return burn

    def _crash(self, now: S, alive: Bool[np.ndarray, "B N"]) -> Float[np.ndarray, "B N"]:
        """Exposure of each agent from its contacts, nats."""
        if not self._law.collision_risk:
            return np.zeros(alive.shape)
        return -np.log1p(-self._law.collision_risk) * self._count_overlaps(now, alive)

    def _count_overlaps(self, now: S, alive: Bool[np.ndarray, "B N"]) -> Float[np.ndarray, "B N"]:
        """Count overlapping pairs; return with how many others each live agent overlaps."""
        touching = np.empty(alive.shape)
        plane.count_overlaps(now.position, now.closest, alive, 2 * self.radius, touching, now.overlaps)
        return touching


def deaths_by_cause(sim: Sim, ids: Int[np.ndarray, "n"]) -> dict[str, Float[np.ndarray, "n"]]:
    """``deaths_<cause>``: how many agents each cause killed."""
    dead, cause = sim.field["health"][ids] == 0, sim.field["death_cause"][ids]
    return {
        name: (dead & (cause == k)).sum(axis=1).astype(np.float64) for k, name in enumerate(DEATH_METRICS)
    }


def scene(spec: TaskSpec, params: ParticleParams, radius: float, points: Mapping[str, str]) -> mujoco.MjSpec:
    """A floor with N particles of some radius, m, and points by name and kind of looks.

    Particle i's joints, looks and motors are prefixed ``drone<i>/``; points are mocap bodies, so that they
    are part of the row.
    """
    world = asset("arena.xml")
    world.option.timestep = spec.control_step
    world.option.integrator = mujoco.mjtIntegrator.mjINT_EULER
    # contacts are ours, and nothing moves out of the plane
    off = mujoco.mjtDisableBit
    world.option.disableflags = int(off.mjDSBL_CONTACT | off.mjDSBL_CONSTRAINT | off.mjDSBL_GRAVITY)
    factor = _factor(params)
    for i in range(spec.num_agents):
        particle = asset("particle.xml")
        for joint in particle.joints:
            joint.damping[0] = (factor - 1) / spec.control_step  # the other entries are of higher order
        for motor in particle.actuators:
            motor.group = i
            motor.gear[0] = factor
        particle.geom("foot").size[0] = radius
        attach(world, particle, f"drone{i}/")
    for name, kind in points.items():
        add_marker(world, name, kind).pos[2] = HEIGHT
    return world


def place(sim: Sim, ids: Int[np.ndarray, "n"], chance: Float[np.ndarray, "n C"], half_width: float) -> None:
    """Put agents at rest, independently and uniformly; they may overlap."""
    sim.position[ids] = half_width * (2 * chance - 1)


def _factor(params: ParticleParams) -> float:
    """By which implicit damping divides, so that forces are multiplied by it."""
    return 1 / (1 - params.damping)
