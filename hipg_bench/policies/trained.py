"""A trained policy played as an agent: the folder of a training run, or a policy file by itself."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path
from typing import Any

import pydantic

from hipg_bench import registry
from hipg_bench.documents import read_json
from hipg_bench.errors import BundleError, UnknownNameError
from hipg_bench.policies.bundle import Agent, agents, load_agent
from hipg_bench.policies.card import Card, Training, check_regular
from hipg_bench.spec import TaskSpec, parse

RECORD = "train.json"
"""The file in a run's folder that says what was trained."""
POLICY = "policy.safetensors"


class _Settings(pydantic.BaseModel):
    model_config = pydantic.ConfigDict(extra="allow")

    seed: int = pydantic.Field(ge=0, le=999_999_999)


class Record(pydantic.BaseModel):
    """What a run's ``train.json`` holds, as far as playing its policy needs it.

    Attributes:
        command: the command that trained it.
        task: its task's name.
        task_fingerprint: which version of the task.
        spec: the task itself where it is not one of the benchmark.
        settings: the learner's.
        env_steps: environment steps so far.
        seconds: time they took, s.
        machine: the processor.
    """

    model_config = pydantic.ConfigDict(extra="allow")

    command: str
    task: str
    task_fingerprint: str
    spec: dict[str, Any] | None = None
    settings: _Settings
    env_steps: int = pydantic.Field(ge=0)
    seconds: float = pydantic.Field(ge=0)
    machine: str = ""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Trained(Agent):
    """One policy file as an agent.

    Attributes:
        file: the policy file.
        seed: its training seed.
        task: the task that it was trained for, None where nothing tells.
    """

    file: Path
    seed: int = 0
    task: str | None = None

    @property
    def tasks(self) -> tuple[str, ...]:  # pyright: ignore[reportIncompatibleVariableOverride]
        """The task that it was trained for; others with the same vectors can be played too."""
        return () if self.task is None else (self.task,)

    def train_seeds(self, task: str) -> tuple[int, ...]:
        """Its one training seed, whatever the task: whether its network fits is seen when it is loaded."""
        return (self.seed,)

    def _weights(self, task: str, train_seed: int) -> Path:
        check_regular(self.file)
        return self.file


def find_agent(name_or_path: str | Path, *, trust: bool = False) -> Agent:
    """Find an agent: a bundled one's name, a bundle's folder, a training run's folder, or a policy file.

    A run's own task, if it is none of the benchmark, is known in this process from then on.

    Args:
        name_or_path: which.
        trust: as in `load_agent`.

    Raises:
        UnknownNameError: none of these; the message holds the nearest name.
        BundleError: a bundle, run or file that is refused.
    """
    path = Path(name_or_path)
    if str(name_or_path) in agents() or (path / "agent.toml").is_file():
        return load_agent(name_or_path, trust=trust)
    if (path / RECORD).is_file():
        return _of_run(path)
    if path.is_file():
        return _of_file(path)
    if path.is_dir():
        raise BundleError(f"{path} holds neither an agent's agent.toml nor a training run's {RECORD}")
    if path.suffix or "/" in str(name_or_path):
        raise UnknownNameError(f"no agent {str(name_or_path)!r}: there is no such file or folder")
    return load_agent(name_or_path, trust=trust)


def read_record(folder: Path) -> Record:
    """Read a training run's record; its task is known in this process from then on.

    Raises:
        BundleError: the task has changed since the training.
        SpecError: the record or its task is damaged.
    """
    record = parse(Record, read_json(folder / RECORD), str(folder / RECORD))
    if record.spec is not None:
        registry.add_task(parse(TaskSpec, record.spec, f"{folder / RECORD}: spec"))
    spec = registry.task_spec(record.task)
    if spec.fingerprint != record.task_fingerprint:
        raise BundleError(
            f"{folder} was trained on {record.task} with the fingerprint {record.task_fingerprint}, "
            f"and the task has {spec.fingerprint} now: train again"
        )
    return record


def _of_run(folder: Path) -> Trained:
    record = read_record(folder)
    if not (folder / POLICY).is_file():
        raise BundleError(f"{folder} holds no {POLICY} yet: let it train for an iteration at least")
    training = Training(
        env_steps=record.env_steps, hours=record.seconds / 3600, hardware=record.machine[:300],
        framework="hipg-bench train",
    )  # fmt: skip
    summary = f"Training run {folder}: {record.env_steps:,} steps on {record.task}"
    return Trained(
        card=_card(folder.resolve().name, summary, training), folder=folder,
        file=folder / POLICY, seed=record.settings.seed, task=record.task,
    )  # fmt: skip


def _of_file(path: Path) -> Trained:
    if path.suffix != ".safetensors":
        raise BundleError(
            f"{path}: policy files end in .safetensors; what is an ONNX graph or Python plays from a bundle: "
            f"hipg-bench submit init"
        )
    if (path.parent / RECORD).is_file() and path.name == POLICY:
        return _of_run(path.parent)
    # bundles name the folder after the task, and the file after the training seed
    task, seed = path.resolve().parent.name, re.fullmatch(r"seed([0-9]{1,9})", path.stem)
    known = task in registry.tasks()
    name = f"{task}_{path.stem}" if known else path.stem
    return Trained(
        card=_card(name, f"Policy file {path}", Training()),
        folder=path.parent, file=path, seed=int(seed[1]) if seed else 0, task=task if known else None,
    )  # fmt: skip


def _card(name: str, summary: str, training: Training) -> Card:
    plain = re.sub(r"[^a-z0-9]+", "_", name.lower()).strip("_")[:64] or "policy"
    return Card(name=plain, summary=summary[:300], kind="network", training=training)
