"""Published runs again, from what a bundle holds alone: settings, steps, and the initial policy."""

from __future__ import annotations

import dataclasses
import hashlib
from pathlib import Path
from typing import Any

import pydantic

from hipg_bench.documents import read_json
from hipg_bench.errors import BundleError, hint
from hipg_bench.learning.settings import ALGORITHMS, AnySettings
from hipg_bench.policies.bundle import Agent
from hipg_bench.registry import task_spec
from hipg_bench.spec import parse


class _Result(pydantic.BaseModel):
    score: float | None = None


class _Record(pydantic.BaseModel):
    task_fingerprint: str
    settings: dict[str, Any]
    env_steps: int = pydantic.Field(ge=1)
    seconds: float = pydantic.Field(ge=0)
    machine: str = ""
    versions: dict[str, str] = {}
    initial_policy_fingerprint: str | None = None
    result: _Result = _Result()


@dataclasses.dataclass(frozen=True)
class Published:
    """A run whose policy is in a bundle.

    Attributes:
        settings: what it was run with, and for how many steps.
        policy: the published policy file.
        seconds: time it took, s.
        machine: the processor.
        versions: of the packages.
        score: of the published policy, None where its task has no score scale.
    """

    settings: AnySettings
    policy: Path
    seconds: float
    machine: str
    versions: dict[str, str]
    score: float | None


def published(agent: Agent, task: str, seed: int) -> Published:
    """Read a run that a bundle was made of.

    Raises:
        BundleError: it has no such run, not all that the run began with, or the task has changed since.
        SpecError: the record is damaged, or has a setting that is not allowed any more.
    """
    place = agent.folder / task / f"seed{seed}"
    path = place.with_suffix(".json")
    if not path.is_file():
        there = [f"{one.parent.name} {one.stem[4:]}" for one in sorted(agent.folder.glob("*/seed*.json"))]
        raise BundleError(
            f"agent {agent.name!r} has no record of a run on {task} with seed {seed}"
            f"{hint(f'{task} {seed}', there)}"
        )
    record = parse(_Record, read_json(path), str(path))
    if record.task_fingerprint != task_spec(task).fingerprint:
        raise BundleError(f"{path} is of another version of {task}: its run cannot be repeated")
    values = {**record.settings, "steps": record.env_steps}
    if values.get("initial_policy"):
        values["initial_policy"] = str(_initial(place, str(record.settings["initial_policy"]), record))
    kind = ALGORITHMS.get(str(values.get("algorithm")))
    if kind is None:
        raise BundleError(f"{path}: no algorithm {values.get('algorithm')!r}{hint('', ALGORITHMS)}")
    return Published(
        settings=parse(kind, values, str(path)), policy=place.with_suffix(".safetensors"),
        seconds=record.seconds, machine=record.machine, versions=record.versions, score=record.result.score,
    )  # fmt: skip


def _initial(place: Path, recorded: str, record: _Record) -> Path:
    """The policy that the run began with, which bundles keep beside the one that it ended with.

    Raises:
        BundleError: it is missing, or another one.
    """
    path = place.with_suffix(".initial.safetensors")
    if not path.is_file():
        raise BundleError(f"the run began with {recorded}, and {path.name} is not in {path.parent}")
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    if not digest.startswith(record.initial_policy_fingerprint or digest):
        raise BundleError(f"{path} is not the policy that the run began with")
    return path
