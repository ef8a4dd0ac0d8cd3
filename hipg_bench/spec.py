"""A task's numbers: frozen, complete, read from one TOML file.

The file says what every number is; nothing has a second default elsewhere. Family numbers are
validated by the family's own ``Params`` model, so an unknown or impossible value is refused with
the field, the value and the range.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal, TypeVar, cast

import numpy as np
import pydantic

from hipg_bench.documents import read_toml
from hipg_bench.errors import SpecError, abbreviate, hint

M = TypeVar("M", bound=pydantic.BaseModel)


class Params(pydantic.BaseModel):
    """Base of every family's numbers: frozen, finite, no unknown fields."""

    model_config = pydantic.ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class Anchor(Params):
    """A measured return that fixes a score."""

    mean: float
    ci95: tuple[float, float]
    episodes: int


class Anchors(Params):
    """Returns that fix the score scale: 0 at ``random``, 1 at ``reference``.

    Attributes:
        random: uniformly random actions.
        reference: the scripted expert, or a stated feat.
        reference_is: what the reference is.
    """

    random: Anchor
    reference: Anchor
    reference_is: str = "scripted expert with the joint state"


class TaskSpec(Params):
    """Everything that defines a task.

    Attributes:
        task: its name, ``<family-like name>-<agents>``.
        family: the Python file with its physics and rules.
        version: raised whenever behaviour changes.
        tags: ``standard``, ``paper``, ``planar``, ...
        summary: one sentence for lists.
        num_agents: N, 2..31 (MuJoCo has 31 actuator groups).
        horizon: control steps per episode, T.
        control_step: seconds per control step.
        clip_actions: clip to [-1, 1]; off only in the paper suite, as in the authors' code.
        graded_health: health falls with exposure and scales actuator authority, instead of binary.
        reward_dead: what APIs that pay agents one by one and keep the dead in the team pay them: ``none``,
            and the episode is over when all are dead; or ``team``, the team's reward to the end of the
            task's own episode, so that dying spares nobody a cost. `BatchEnv` pays the team, whatever it is.
        dead_observation: what is in a dead agent's row of the observation: ``blank``, its health and zeros;
            or ``live``, what a living agent would observe there, as in the authors' code. Its actions are
            ignored either way, so that this matters only to learners that train on dead agents' samples.
        params: the family's numbers.
        weights: reward per unit of each term.
        floor: return of an episode whose physics diverged; below anything a policy reaches.
        anchors: the score scale; absent while a task is being made.
        calibration: measured facts that show the task needs what it claims to need.
    """

    task: str
    family: str
    version: int = pydantic.Field(ge=1)
    tags: tuple[str, ...]
    summary: str
    num_agents: int = pydantic.Field(ge=2, le=31)
    horizon: int = pydantic.Field(ge=1, le=100_000)
    control_step: float = pydantic.Field(gt=0, le=10)
    clip_actions: bool = True
    graded_health: bool = False
    reward_dead: Literal["none", "team"] = "none"
    dead_observation: Literal["blank", "live"] = "blank"
    params: dict[str, Any]
    weights: dict[str, float]
    floor: float
    anchors: Anchors | None = None
    calibration: dict[str, float] = {}

    @property
    def fingerprint(self) -> str:
        """Twelve hex digits over everything that affects behaviour (not over anchors or prose)."""
        without = {"anchors", "calibration", "summary", "tags", "reward_dead"}
        if self.dead_observation == "blank":
            without.add("dead_observation")  # so that tasks keep the fingerprints they had without this field
        behaviour = self.model_dump(exclude=without)
        text = json.dumps(behaviour, sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:12]

    def score(self, episode_return: float) -> float:
        """Return on the anchors' scale: 0 as random, 1 as the reference, not clipped.

        Raises:
            SpecError: the task has no anchors.
        """
        if self.anchors is None:
            raise SpecError(
                f"{self.task} has no anchors yet: measure them with `hipg-bench calibrate {self.task}`"
            )
        low, high = self.anchors.random.mean, self.anchors.reference.mean
        return (episode_return - low) / (high - low)

    @property
    def numbers(self) -> tuple[str, ...]:
        """Names that `override` takes."""
        return (*_OWN_NUMBERS, "weights", *self.params)

    def override(self, **changes: Any) -> TaskSpec:
        """Return this spec with some numbers changed, anchors dropped where behaviour changed.

        A change names a spec field, a field of ``params``, or ``weights`` (a partial dict).

        Raises:
            SpecError: unknown field, or a value that is not allowed.
        """
        changes = {name: _plain(value, f"{self.task}: {name}") for name, value in changes.items()}
        values = self.model_dump()
        for name, value in changes.items():
            if name in _OWN_NUMBERS:
                values[name] = value
            elif name == "weights":
                if not isinstance(value, Mapping):
                    raise SpecError(
                        f"{self.task}: weights = {abbreviate(value)} is refused: a mapping is allowed"
                    )
                unknown = set(value) - set(self.weights)
                if unknown:
                    raise SpecError(
                        f"{self.task}: no reward term {min(unknown)!r}{hint(min(unknown), self.weights)}"
                    )
                values["weights"] = {**self.weights, **value}
            elif name in self.params:
                values["params"] = {**values["params"], name: value}
            else:
                raise SpecError(f"{self.task}: no field {name!r}{hint(name, self.numbers)}")
        changed = parse(TaskSpec, values, self.task)
        if changed.fingerprint == self.fingerprint:
            return changed
        return changed.model_copy(update={"anchors": None, "calibration": {}})


_OWN_NUMBERS = (
    "num_agents", "horizon", "control_step", "clip_actions", "graded_health", "reward_dead",
    "dead_observation",
)  # fmt: skip
"""Fields of a spec that `TaskSpec.override` changes beside those of the family."""


def _plain(value: Any, what: str) -> Any:
    """A value as a task file could hold it; NumPy's numbers become Python's.

    Raises:
        SpecError: a task file could not.
    """
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, Mapping):
        values = cast(Mapping[Any, Any], value)
        return {name: _plain(one, f"{what}.{name}") for name, one in values.items()}
    if isinstance(value, list | tuple):
        return [_plain(one, what) for one in cast(list[Any], value)]
    if not isinstance(value, str | int | float | bool | None):
        raise SpecError(
            f"{what} = {abbreviate(value)} is refused: numbers, text and lists of these are allowed"
        )
    return value


def parse(kind: type[M], values: dict[str, Any], where: str) -> M:
    """Validate ``values`` as ``kind``.

    Raises:
        SpecError: naming the place, the field, the value got and what is allowed.
    """
    try:
        return kind(**values)
    except pydantic.ValidationError as error:
        # an unknown field first: where a name is misspelt, the right one is missing too
        first = min(error.errors(), key=lambda problem: problem["type"] != "extra_forbidden")
        field = ".".join(str(part) for part in first["loc"])
        if first["type"] == "extra_forbidden":
            raise SpecError(f"{where}: no field {field!r}{hint(field, kind.model_fields)}") from error
        if first["type"] == "missing":
            raise SpecError(f"{where}: {field} is required and missing") from error
        raise SpecError(
            f"{where}: {field} = {abbreviate(first['input'])} is refused: {first['msg']}"
        ) from error


def load(path: Path) -> TaskSpec:
    """Read one task file.

    Raises:
        SpecError: the file does not hold a valid task, or its name is not the task's.
    """
    spec = parse(TaskSpec, read_toml(path), str(path))
    if spec.task != path.stem:
        raise SpecError(f"{path}: holds the task {spec.task!r}; a task file is named after its task")
    return spec


def to_toml(spec: TaskSpec) -> str:
    """A task file's text, without anchors and calibration."""
    values = spec.model_dump(mode="json", exclude={"anchors", "calibration"})
    tables = {name: values.pop(name) for name in ("params", "weights")}
    lines = [f"{name} = {json.dumps(value, ensure_ascii=False)}" for name, value in values.items()]
    for name, table in tables.items():
        lines += ["", f"[{name}]", *(f"{key} = {json.dumps(value)}" for key, value in table.items())]
    return "\n".join(lines) + "\n"
