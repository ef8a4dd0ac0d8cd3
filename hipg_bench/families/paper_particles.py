"""Particles in a plane: body, physics, contacts, deaths and senses that the paper's tasks share.

The numbers and laws are those of the authors' code, see ``docs/paper_suite.md``. One control step is
one physics step: v <- (1 - damping) v + F dt, then x <- x + v dt. MuJoCo's Euler integrator, which
treats joint damping D implicitly, does exactly this for a mass of 1 kg when 1 + dt D = 1 / (1 - damping)
and every force is multiplied by that same factor: v' = (v + dt factor F) / (1 + dt D).
"""

from __future__ import annotations

from typing import Literal, NamedTuple, Protocol, runtime_checkable

import mujoco
import numpy as np
import pydantic
from jaxtyping import Bool, Complex, Float, Int, Shaped

from hipg_bench.families.family import Harm, Rows
from hipg_bench.families.scene import asset, attach
from hipg_bench.layout import Block, Layout
from hipg_bench.mechanics import hazards, histogram
from hipg_bench.mechanics import health as health_law
from hipg_bench.mechanics.pairs import Gaps, between_agents, few, members, of_both, repulsion
from hipg_bench.sim import Sim
from hipg_bench.spec import Params, TaskSpec

ACTION = Layout((Block("force", (2,), "N", "world"),))
CAUSES = ("hazard", "collision")
_HAZARD, _COLLISION = range(len(CAUSES))
DEATH_METRICS = tuple(f"deaths_{cause}" for cause in CAUSES)

HEIGHT = 0.03
"""Of points above the floor, so that a camera sees them; the rules know no height, m."""

LISTED = 5
"""Dead agents that the histogram observation lists."""
CELLS = (histogram.RINGS, histogram.SECTORS)
IN_RANGE = f"within {histogram.EDGES[-1]:g} m"


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


@runtime_checkable
class Body(Protocol):
    """What the snapshots of both families hold."""

    @property
    def position(self) -> Float[np.ndarray, "B N 2"]:
        """In m."""
        ...

    @property
    def velocity(self) -> Float[np.ndarray, "B N 2"]:
        """In m/s."""
        ...

    @property
    def health(self) -> Float[np.ndarray, "B N"]:
        """1 or 0."""
        ...


class Past(NamedTuple):
    """What the previous control step left behind, from which its histogram is counted again."""

    position: Float[np.ndarray, "B N 2"]
    velocity: Float[np.ndarray, "B N 2"]
    health: Float[np.ndarray, "B N"]
    exists: Bool[np.ndarray, "B"]
    """False in an episode's first observation."""


def scene(spec: TaskSpec, params: ParticleParams, radius: float) -> mujoco.MjSpec:
    """A floor with N particles; particle i's joints, looks and motors are prefixed ``drone<i>/``."""
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
    return world


def memory(params: ParticleParams, num_agents: int) -> dict[str, int]:
    """Fields of an episode that particles need: the last velocity, and the step before where it is seen."""
    velocity = {"velocity": 2 * num_agents}
    if params.observation == "direct":
        return velocity
    return {
        **velocity,
        "past_position": 2 * num_agents,
        "past_velocity": 2 * num_agents,
        "past_health": num_agents,
    }


def place(sim: Sim, ids: Int[np.ndarray, "n"], chance: Float[np.ndarray, "n C"], half_width: float) -> None:
    """Put agents at rest, independently and uniformly; they may overlap."""
    sim.position[ids] = half_width * (2 * chance - 1)


def act(sim: Sim, params: ParticleParams, radius: float, action: Float[np.ndarray, "B N 2"]) -> None:
    """Push the living, by their own force and by contact; the dead stand still at once and touch nobody."""
    alive = sim.field["health"] > 0
    np.copyto(sim.velocity, 0.0, where=np.repeat(~alive, 2, axis=1))
    sim.control[:] = action.reshape(len(action), -1)
    apart = between_agents(sim.position.reshape(action.shape))
    push = repulsion(apart, alive, 2 * radius, params.contact_stiffness, params.contact_margin)
    sim.applied[:] = _factor(params) * push.reshape(len(action), -1)


def kinematics(
    sim: Sim, num_agents: int, rows: Rows
) -> tuple[Float[np.ndarray, "n N 2"], Float[np.ndarray, "n N 2"]]:
    """Positions (m) and velocities (m/s); that of a dead agent is the one it died with."""
    alive = np.repeat(sim.field["health"][rows] > 0, 2, axis=1)
    velocity = np.where(alive, sim.velocity[rows], sim.field["velocity"][rows])
    position = sim.position[rows].copy()
    return position.reshape(-1, num_agents, 2), velocity.reshape(-1, num_agents, 2)


def past(sim: Sim, num_agents: int, rows: Rows) -> Past:
    """The previous control step, as the rows remember it."""
    field = sim.field
    return Past(
        position=field["past_position"][rows].reshape(-1, num_agents, 2).copy(),
        velocity=field["past_velocity"][rows].reshape(-1, num_agents, 2).copy(),
        health=field["past_health"][rows].copy(),
        exists=field["elapsed"][rows, 0] > 0,
    )


def remember(sim: Sim, was: Body, now: Body, *, past: bool) -> None:
    """Write what outlives the step: the velocity that the dead keep, and the step before if it is seen."""
    field = sim.field
    field["velocity"][:] = now.velocity.reshape(len(now.velocity), -1)
    if past:
        field["past_position"][:] = was.position.reshape(len(was.position), -1)
        field["past_velocity"][:] = was.velocity.reshape(len(was.velocity), -1)
        field["past_health"][:] = was.health


def touching(apart: Gaps, radius: float) -> Bool[np.ndarray, "P B"]:
    """Pairs that overlap, dead or alive."""
    return apart.distance < 2 * radius


def harm(
    params: ParticleParams,
    burn: Float[np.ndarray, "B N"],
    touch: Bool[np.ndarray, "P B"],
    alive: Bool[np.ndarray, "B N"],
) -> Harm:
    """Exposure from hazards, and from every contact with another live agent.

    Args:
        params: the family's numbers.
        burn: exposure from hazards, nats.
        touch: pairs that overlap.
        alive: before this step.
    """
    which, world = few(touch)
    one, other = (agents[which] for agents in members(alive.shape[1]))
    crash = np.zeros_like(burn)
    risk = np.where(alive[world, one] & alive[world, other], -np.log1p(-params.collision_risk), 0.0)
    np.add.at(crash, (world, one), risk)
    np.add.at(crash, (world, other), risk)
    cause = np.where(crash > burn, _COLLISION, _HAZARD)
    return Harm(burn + crash, fatal=np.zeros_like(alive), cause=cause)


def burn(
    params: ParticleParams,
    distance: Float[np.ndarray, "L N B"],
    hazardous: Bool[np.ndarray, "B L"],
    control_step: float,
) -> Float[np.ndarray, "B N"]:
    """Exposure of each agent from the points that are hazardous, nats."""
    exposure = np.zeros((distance.shape[2], distance.shape[1]))
    # few agents are near a point: the law is worked out only for them
    point, agent, world = few(distance < params.hazard_radius)
    risk = hazards.risk(distance[point, agent, world], params.hazard_radius, params.hazard_peak)
    risk = np.where(hazardous[world, point], risk, 0.0)
    np.add.at(exposure, (world, agent), health_law.hazard_rate(risk, control_step / 0.1))
    return exposure


def deaths_by_cause(sim: Sim, ids: Int[np.ndarray, "n"]) -> dict[str, Float[np.ndarray, "n"]]:
    """``deaths_<cause>``: how many agents each cause killed."""
    dead, cause = sim.field["health"][ids] == 0, sim.field["death_cause"][ids]
    return {
        name: (dead & (cause == k)).sum(axis=1).astype(np.float64) for k, name in enumerate(DEATH_METRICS)
    }


def agents_around(apart: Gaps, alive: Bool[np.ndarray, "B N"]) -> Int[np.ndarray, "B N 4 8"]:
    """Histogram of the other live agents around each agent."""
    first, second = members(alive.shape[1])
    one, other = of_both(alive)
    cell = histogram.cells(apart.gap, apart.distance)
    return histogram.tally(
        np.concatenate([cell, histogram.opposite(cell)]),
        np.concatenate([other, one]),
        np.concatenate([first, second]),
        alive.shape[1],
    )


def points_around(away: Gaps, counted: Bool[np.ndarray, "L B"]) -> Int[np.ndarray, "B N 4 8"]:
    """Histogram of the points that count around each agent."""
    points, agents, worlds = away.distance.shape
    cell = histogram.cells(away.gap, away.distance).reshape(-1, worlds)
    observer = np.tile(np.arange(agents), points)
    return histogram.tally(cell, np.repeat(counted, agents, axis=0), observer, agents)


def nearest_dead(
    position: Float[np.ndarray, "B N 2"], dead: Bool[np.ndarray, "B N"]
) -> Float[np.ndarray, "B N 5 2"]:
    """Where the nearest other dead agents lie relative to each agent, m, at any distance; zeros beyond."""
    found = np.zeros((*dead.shape, LISTED, 2))
    ids = np.flatnonzero(dead.any(axis=1))
    if not len(ids):
        return found
    # only as many columns as the worst world has dead
    place, dead = _complex(position[ids]), dead[ids]
    which = np.argsort(~dead, axis=1, stable=True)[:, : dead.sum(axis=1).max()]
    gap = np.take_along_axis(place, which, axis=1)[:, None] - place[:, :, None]
    agents = np.arange(dead.shape[1])[:, None]
    counts = np.take_along_axis(dead, which, axis=1)[:, None] & (which[:, None] != agents)
    squared = np.where(counts, np.real(gap) ** 2 + np.imag(gap) ** 2, np.inf)
    order = np.argsort(squared, axis=-1, stable=True)[..., :LISTED]
    nearest = np.take_along_axis(np.where(counts, gap, 0.0), order, axis=-1)
    found[ids, :, : order.shape[-1]] = nearest.view(np.float64).reshape(*nearest.shape, 2)
    return found


def own_blocks() -> tuple[Block, ...]:
    """What every observation begins with."""
    return (
        Block("terminated", (1,), "1", "-", "1 once dead"),
        Block("velocity", (2,), "m/s", "world"),
        Block("position", (2,), "m", "world"),
    )


def around_blocks() -> tuple[Block, ...]:
    """What every histogram observation ends with, per step."""
    return (
        Block("other_count", CELLS, "agents", "own", f"{IN_RANGE}, live agents"),
        Block("dead_position", (LISTED, 2), "m", "own", "nearest dead agents, at any distance"),
    )


def two_steps(look: Layout) -> Layout:
    """A histogram observation: this control step, then the previous one."""
    before = tuple(
        Block(f"previous_{b.name}", b.shape, b.unit, b.frame, f"{b.visible}; one step ago, 0 at first")
        for b in look.blocks
    )
    return Layout((*look.blocks, *before))


def others(table: Shaped[np.ndarray, "*B N N"]) -> Shaped[np.ndarray, "*B N N-1"]:
    """Drop each agent's entry about itself."""
    n = table.shape[-1]
    # behind the first entry, every (N + 1)th lies on the diagonal
    rows = table.reshape(-1, n * n)[:, 1:].reshape(-1, n - 1, n + 1)[..., :-1]
    return rows.reshape(*table.shape[:-1], n - 1)


def relative(
    of: Float[np.ndarray, "B N 2"], shown: Bool[np.ndarray, "B N N-1"]
) -> Float[np.ndarray, "B N N-1 2"]:
    """A quantity of every other agent, in their order, less the observer's own; zeros where not shown."""
    vector = _complex(of)
    gap = np.where(shown, others(vector[:, None] - vector[:, :, None]), 0.0)
    return gap.view(np.float64).reshape(*gap.shape, 2)


def _complex(vector: Float[np.ndarray, "B N 2"]) -> Complex[np.ndarray, "B N"]:
    """Vectors of the plane as one number each, so that axes of two do not slow NumPy down."""
    return np.ascontiguousarray(vector).view(np.complex128)[..., 0]


def _factor(params: ParticleParams) -> float:
    """By which implicit damping divides, so that forces are multiplied by it."""
    return 1 / (1 - params.damping)
