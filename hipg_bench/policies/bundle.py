"""Agent bundles: a folder with ``agent.toml`` and, for networks, weights per task and training seed.

A bundle is data. It names one of the built-in policies or holds tensors; no code is ever imported
by a name that a file holds.
"""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import re
import tomllib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Literal

import pydantic

from hipg_bench import registry
from hipg_bench.errors import BundleError, HipgError, SpecError, UnknownNameError, hint
from hipg_bench.paths import data_folder
from hipg_bench.policies.network import load_network
from hipg_bench.policies.policy import Policy
from hipg_bench.policies.scripted import Scripted
from hipg_bench.policies.simple import Constant, Random, TimeOnly, Zero
from hipg_bench.spec import Params, TaskSpec, parse


def _action_size(spec: TaskSpec) -> int:
    return registry.family_of(spec).layout.action.size


_BUILTIN: Mapping[str, Callable[[TaskSpec], Policy]] = {
    "zero": lambda spec: Zero(_action_size(spec)),
    "random": lambda spec: Random(_action_size(spec)),
    "constant": lambda spec: Constant(_action_size(spec)),
    "time_only": lambda spec: TimeOnly(_action_size(spec)),
    "scripted": lambda spec: Scripted(spec, blind=False),
    "scripted_blind": lambda spec: Scripted(spec, blind=True),
}
"""What ``builtin`` may name."""


class Card(Params):
    """What ``agent.toml`` says.

    Attributes:
        name: lower case, digits and underscores; the folder's name for bundled agents.
        summary: one sentence for lists.
        builtin: a policy that comes with the package, or
        kind: ``network``: the folder holds ``<task>/seed<k>.safetensors``.
        authors, license, link: whom to thank and where to read on.
    """

    name: str = pydantic.Field(pattern=r"^[a-z0-9][a-z0-9_]{0,63}$")
    summary: str = pydantic.Field(min_length=1, max_length=300)
    builtin: str | None = None
    kind: Literal["network"] | None = None
    authors: str = ""
    license: str = ""
    link: str = ""


@dataclasses.dataclass(frozen=True)
class Agent:
    """An agent that may play some tasks, perhaps trained several times for each."""

    card: Card
    folder: Path

    @property
    def name(self) -> str:
        """Its name."""
        return self.card.name

    @property
    def summary(self) -> str:
        """One sentence."""
        return self.card.summary

    @functools.cached_property
    def tasks(self) -> tuple[str, ...]:
        """Names of the tasks that it has a policy for."""
        if self.card.builtin is None:
            return tuple(sorted({path.parent.name for path in self.folder.glob("*/seed*.safetensors")}))
        return tuple(name for name, spec in registry.tasks().items() if self._plays(spec))

    def train_seeds(self, task: str) -> tuple[int, ...]:
        """Training seeds with a policy for a task: (0,) for what is not trained, () if there is none."""
        if self.card.builtin is not None:
            return (0,) if task in self.tasks else ()
        names = [path.stem for path in (self.folder / task).glob("seed*.safetensors")]
        return tuple(sorted(int(name[4:]) for name in names if re.fullmatch(r"seed\d+", name)))

    def policy(self, spec: TaskSpec, train_seed: int = 0) -> Policy:
        """Load the policy for a task.

        Raises:
            BundleError: it has none for the task or training seed, or the weights do not fit.
        """
        if self.card.builtin is not None:
            try:
                return _BUILTIN[self.card.builtin](spec)
            except UnknownNameError as error:
                raise BundleError(f"agent {self.name!r} does not play {spec.task}: {error}") from error
        network = load_network(self._weights(spec.task, train_seed))
        layout = registry.family_of(spec).layout
        sizes, expected = (
            (network.observation_size, network.action_size),
            (layout.observation.size, layout.action.size),
        )
        if sizes != expected:
            raise BundleError(
                f"agent {self.name!r}: {spec.task} has (O, A) = {expected}, its network {sizes}: train again"
            )
        return network

    def fingerprint(self, task: str, train_seed: int = 0) -> str:
        """Twelve hex digits that tell one policy of this agent from another."""
        if self.card.builtin is not None:
            return hashlib.sha256(self.card.builtin.encode()).hexdigest()[:12]
        return hashlib.sha256(self._weights(task, train_seed).read_bytes()).hexdigest()[:12]

    def _weights(self, task: str, train_seed: int) -> Path:
        path = self.folder / task / f"seed{train_seed}.safetensors"
        if path.is_file():
            return path
        seeds = self.train_seeds(task)
        if seeds:
            raise BundleError(
                f"agent {self.name!r} has no training seed {train_seed} for {task}; there are: {seeds}"
            )
        raise BundleError(
            f"agent {self.name!r} has no weights for {task}{hint(task, self.tasks) if self.tasks else ''}"
        )

    def _plays(self, spec: TaskSpec) -> bool:
        try:
            self.policy(spec)
        except HipgError:
            return False
        return True


def agents() -> tuple[str, ...]:
    """Names of the bundled agents."""
    return tuple(sorted(path.parent.name for path in data_folder("agents").glob("*/agent.toml")))


def load_agent(name_or_path: str | Path) -> Agent:
    """Read a bundle: a bundled agent's name, or the path of a folder with ``agent.toml``.

    Raises:
        UnknownNameError: neither; the message holds the nearest name.
        BundleError: ``agent.toml`` is refused.
    """
    if str(name_or_path) in agents():
        return _read(data_folder("agents") / name_or_path)
    folder = Path(name_or_path)
    if (folder / "agent.toml").is_file():
        return _read(folder)
    if folder.is_dir():
        raise BundleError(f"{folder} holds no agent.toml: it is not an agent bundle")
    raise UnknownNameError(f"no agent {str(name_or_path)!r}{hint(str(name_or_path), agents())}")


def _read(folder: Path) -> Agent:
    path = folder / "agent.toml"
    try:
        card = parse(Card, tomllib.loads(path.read_text(encoding="utf-8")), str(path))
    except (SpecError, tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise BundleError(f"{path}: {error}" if not isinstance(error, SpecError) else str(error)) from error
    if (card.builtin is None) == (card.kind is None):
        raise BundleError(f"{path}: exactly one of 'builtin' and 'kind' is allowed")
    if card.builtin is not None and card.builtin not in _BUILTIN:
        raise BundleError(f"{path}: no built-in policy {card.builtin!r}{hint(card.builtin, _BUILTIN)}")
    return Agent(card, folder)
