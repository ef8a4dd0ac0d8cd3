"""What a family must say, so that `hipg_bench.engine` can run it: declarations, and rules of one world.

A family is a module. Its records (`World`, `Previous`, `Scratch`, `Numbers`, `Terms`, `Metrics`) extend those
below; its rules are plain functions with loops over agents, compiled by `hipg_bench.native` or run as Python.
In a rule: no exceptions, no allocation, no dictionaries; ``a[:] = b`` is written as a loop.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from types import ModuleType, SimpleNamespace
from typing import Any, Protocol, cast, get_type_hints, runtime_checkable

import mujoco
import numpy as np
from jaxtyping import Bool, Float, Int

from hipg_bench import records
from hipg_bench.errors import SpecError
from hipg_bench.layout import TaskLayout
from hipg_bench.spec import Params, TaskSpec, parse

NEVER = -1.0
"""Death time of the living."""


class World:
    """What evolves in a world. What MuJoCo does not move itself is memory of the episode, in ``userdata``."""

    health: Float[np.ndarray, "N"]
    cumulative_hazard: Float[np.ndarray, "N"]  # nats
    hazard_threshold: Float[np.ndarray, "N"]  # nats
    death_time: Float[np.ndarray, "N"]  # control steps, `NEVER` while alive
    death_cause: Float[np.ndarray, "N"]  # index into the family's causes
    episode_id: float
    elapsed: float  # control steps
    episode_return: float  # so far


class Previous:
    """What a control step is compared with."""

    health: Float[np.ndarray, "N"]


class Scratch:
    """What a step works out and forgets."""

    harm: Float[np.ndarray, "N"]  # cumulative hazard gained, nats
    fatal: Bool[np.ndarray, "N"]  # killed outright
    cause: Int[np.ndarray, "N"]  # index into the family's causes, of those who die in this step
    command: Float[np.ndarray, "N A"]


class Numbers:
    """Numbers of a task that do not change."""

    horizon: float  # control steps
    control_step: float  # s
    reference_steps: float  # control step over the 0.1 s for which chances of death are given
    floor: float
    graded_health: bool
    clip_actions: bool
    blank_dead: bool  # whether the dead observe nothing
    dead_value: float
    health_column: int  # of an observation
    weights: Float[np.ndarray, "T"]
    bad: Int[np.ndarray, "2"]  # MuJoCo's warnings of bad physics, first and last + 1
    quiet: int  # where their counts begin
    coordinates: Int[np.ndarray, "W 2"]  # columns of a row: positions, velocities, warm start


class Terms:
    """Parts of the team reward, before weights."""


class Metrics:
    """Of an episode that is over."""

    episode_return: float
    length: float  # control steps
    survival: float
    deaths: float
    first_death: float  # control steps


# --- rules that a family may leave out -----------------------------------------------------------------


def survey(w: World, scratch: Scratch, task: Numbers) -> None:
    """Work out what all observers share: nothing."""


def update(w: World, previous: Previous, scratch: Scratch, task: Numbers) -> None:
    """Change what the episode remembers, once it is known who died: nothing."""


def observe_previous(w: World, scratch: Scratch, task: Numbers, i: int, seen: Any) -> bool:
    """Observe the step before, as the row remembers it; return whether the agent observed anything."""
    return False


def end(w: World, scratch: Scratch, task: Numbers) -> int:
    """Never before the horizon: dying must not save a team from being charged."""
    return 0


# --- declarations --------------------------------------------------------------------------------------


@runtime_checkable
class Family(Protocol):
    """A module with the declarations and rules of a family.

    Attributes:
        Params: the family's numbers in a task file, a pydantic model.
        World, Previous, Scratch, Numbers, Terms, Metrics: its records.
        PHYSICS: component of MuJoCo's state to the fields of `World` that lie in it, in their order; the
            other fields are kept in ``userdata``.
        CAUSES: names of what kills.
        REASONS: names of why the rules end an episode, from 3 on; 1 is the horizon, 2 diverged physics.

    A module may also declare ``PARENT``, the name of a family from which it has what it does not declare;
    ``RENDERING`` and ``EXPERT``, how it is drawn and its scripted expert, as ``module:object``; ``SPLITS``
    and ``SETTINGS``, what evaluation splits do to it and what learners are recommended.
    """

    Params: type[Params]
    World: type[World]
    Previous: type[Previous]
    Scratch: type[Scratch]
    Numbers: type[Numbers]
    Terms: type[Terms]
    Metrics: type[Metrics]
    PHYSICS: Mapping[str, tuple[str, ...]]
    CAUSES: tuple[str, ...]
    REASONS: tuple[str, ...]

    layout: Callable[[TaskSpec, Any], TaskLayout]
    """Observation, action and joint state."""
    scene: Callable[[TaskSpec, Any], mujoco.MjSpec]
    """Compose the world, agent i's actuators in group i, what only a camera sees in `VISUAL_GROUP`."""
    physics_steps: Callable[[TaskSpec], int]
    """Physics steps per control step."""
    num_random: Callable[[TaskSpec, Any], int]
    """Uniform numbers that `begin` takes per episode."""
    sizes: Callable[[TaskSpec, Any], Mapping[str, int]]
    """Letters of axes to their sizes, beside N, A and T."""
    numbers: Callable[[TaskSpec, Any], Mapping[str, Any]]
    """The entries of `Numbers` that are the family's own."""

    begin: Callable[..., None]
    """(w, scratch, task, random): lay out a world."""
    act: Callable[..., None]
    """(w, previous, scratch, task, command): write actuators' inputs, and forces that mechanics add."""
    read: Callable[..., None]
    """(w, scratch, task): work out what the other rules need of where everything is."""
    harm: Callable[..., None]
    """(w, previous, scratch, task): what the step does to the agents, into ``scratch``."""
    reward: Callable[..., None]
    """(w, previous, scratch, task, terms): parts of the team reward."""
    observe: Callable[..., None]
    """(w, scratch, task, i, seen): what agent i observes."""
    state: Callable[..., None]
    """(w, scratch, task, state): the joint state, what a central critic observes."""
    metrics: Callable[..., None]
    """(w, scratch, task, metrics): the family's metrics of an episode that is over."""


_RULES = ("begin", "act", "read", "harm", "reward", "observe", "state", "metrics")
_DEFAULTS = (survey, update, observe_previous, end)
_PARTS = tuple(get_type_hints(Family))
"""All that a family must declare."""


@dataclasses.dataclass(frozen=True)
class Definition:
    """A family's declarations, worked out for one task.

    Attributes:
        spec: the task.
        family: its module.
        params: the family's numbers, checked.
        layout: observation, action and joint state.
        change_scene: what is done to the composed world before it is compiled, if anything.
    """

    spec: TaskSpec
    family: Family
    params: Any
    layout: TaskLayout
    change_scene: Callable[[mujoco.MjSpec], None] | None = None

    def __reduce__(self) -> tuple[Any, ...]:
        """Rules cannot be pickled; the name of their family can."""
        return _by_name, (self.spec, self.change_scene)

    @property
    def causes(self) -> tuple[str, ...]:
        """Names of what kills."""
        return self.family.CAUSES

    @property
    def reasons(self) -> tuple[str, ...]:
        """Why an episode ends, by number; the first is that it does not."""
        return ("", "horizon", "physics", *self.family.REASONS)

    @property
    def metrics(self) -> tuple[str, ...]:
        """Names of the family's own metrics."""
        return tuple(field.name for field in records.fields(self.family.Metrics))[len(METRICS) :]

    @property
    def terms(self) -> tuple[str, ...]:
        """Names of the parts of the team reward."""
        return tuple(field.name for field in records.fields(self.family.Terms))

    @property
    def physics_steps(self) -> int:
        """Physics steps per control step."""
        return self.family.physics_steps(self.spec)

    @property
    def num_random(self) -> int:
        """Uniform numbers of an episode; the first N are the hazard thresholds'."""
        return self.spec.num_agents + self.family.num_random(self.spec, self.params)

    @property
    def sizes(self) -> Mapping[str, int]:
        """Letters of axes to their sizes."""
        common = {"N": self.spec.num_agents, "A": self.layout.action.size, "T": len(self.terms), "W": 3}
        return {**common, **self.family.sizes(self.spec, self.params)}

    @property
    def memory(self) -> Mapping[str, tuple[int, ...]]:
        """What an episode remembers in ``userdata``: name to axes, in order.

        First what every world has, then the family's own, then what it shares with others of its kind.
        """
        fields = {field.name: field for field in records.fields(self.family.World)}
        kinds = [World, *(kind for kind in self.family.World.__mro__ if kind is not World)]
        names = [name for kind in kinds for name in getattr(kind, "__annotations__", ())]
        moved = {name for names in self.family.PHYSICS.values() for name in names}
        return {name: records.shape(fields[name], self.sizes) for name in names if name not in moved}

    @property
    def rules(self) -> Mapping[str, Callable[..., Any]]:
        """The rules by name, as `hipg_bench.engine` knows them."""
        given = {name: getattr(self.family, name) for name in _RULES}
        return given | {rule.__name__: getattr(self.family, rule.__name__, rule) for rule in _DEFAULTS}

    def scene(self) -> mujoco.MjSpec:
        """Compose the world."""
        scene = self.family.scene(self.spec, self.params)
        if self.change_scene is not None:
            self.change_scene(scene)
        return scene


METRICS = ("return", "length", "survival", "deaths", "first_death")
"""Names of the metrics of any task; the first is called `Metrics.episode_return` in rules."""


def _by_name(spec: TaskSpec, change: Callable[[mujoco.MjSpec], None] | None) -> Definition:
    from hipg_bench.families import known

    return dataclasses.replace(known.definition_of(spec), change_scene=change)


def complete(name: str, module: ModuleType, ancestors: Sequence[ModuleType]) -> Family:
    """Put a family together from its module and those it has the rest from, the nearest first.

    Raises:
        SpecError: something is declared in none of them.
    """
    parts: dict[str, Any] = {}
    for each in reversed((module, *ancestors)):
        parts |= {key: value for key, value in vars(each).items() if not key.startswith("_")}
    family = SimpleNamespace(**parts)
    missing = [part for part in _PARTS if not hasattr(family, part)]
    if missing:
        raise SpecError(f"family {name!r} ({module.__name__}) lacks {', '.join(missing)}")
    return cast(Family, family)


def define(spec: TaskSpec, family: Family) -> Definition:
    """Work out a family's declarations for one task.

    Raises:
        SpecError: numbers that the family does not allow, or weights that are not its reward terms.
    """
    params = parse(family.Params, spec.params, spec.task)
    definition = Definition(spec, family, params, family.layout(spec, params))
    if missing := ", ".join(sorted(set(definition.terms) - spec.weights.keys())):
        raise SpecError(f"{spec.task}: weights need {missing}, the family's reward terms")
    return definition
