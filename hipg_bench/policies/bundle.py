"""Agent bundles: a folder with ``agent.toml`` and what acts, per task and training seed.

It names one of the built-in policies, or holds tensors, ONNX graphs or Python. Nothing that a bundle holds is
ever imported or run here: graphs and Python run in a sandboxed process of their own (`foreign`).
"""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import json
import re
from collections.abc import Callable, Mapping
from pathlib import Path

from hipg_bench import registry
from hipg_bench.errors import BundleError, HipgError, UnknownNameError, hint
from hipg_bench.paths import data_folder
from hipg_bench.policies.attention import Attention
from hipg_bench.policies.card import Card, check_regular, read_card
from hipg_bench.policies.foreign import ForeignPolicy
from hipg_bench.policies.graph import check_graph
from hipg_bench.policies.network import load_network, network_digest
from hipg_bench.policies.policy import Policy
from hipg_bench.policies.scripted import Scripted
from hipg_bench.policies.simple import Constant, Random, TimeOnly, Zero
from hipg_bench.sandbox.files import bundle_files
from hipg_bench.spec import TaskSpec


def _action_size(spec: TaskSpec) -> int:
    return registry.definition_of(spec).layout.action.size


_SEED_FILE = re.compile(r"seed(0|[1-9][0-9]{0,8})")
"""What a policy's file is called, but for the ending."""

_BUILTIN: Mapping[str, Callable[[TaskSpec], Policy]] = {
    "zero": lambda spec: Zero(_action_size(spec)),
    "random": lambda spec: Random(_action_size(spec)),
    "constant": lambda spec: Constant(_action_size(spec)),
    "time_only": lambda spec: TimeOnly(_action_size(spec)),
    "scripted": lambda spec: Scripted(spec, blind=False),
    "scripted_blind": lambda spec: Scripted(spec, blind=True),
}
"""What ``builtin`` may name."""


@dataclasses.dataclass(frozen=True)
class Agent:
    """An agent that may play some tasks, perhaps trained several times for each.

    Attributes:
        card: what it says of itself.
        folder: where it lies.
        trust: its code may run without a sandbox; what comes of it is never verified.
    """

    card: Card
    folder: Path
    trust: bool = False

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
        if self.card.kind == "builtin":
            return tuple(name for name, spec in registry.tasks().items() if self._plays(spec))
        if self.card.kind == "python":
            return tuple(sorted(self.card.tasks))
        return tuple(sorted({path.parent.name for path in self.folder.glob(f"*/seed*{self._ending}")}))

    def train_seeds(self, task: str) -> tuple[int, ...]:
        """Training seeds with a policy for a task: (0,) for what is not trained, () if there is none.

        Raises:
            BundleError: a file's name is not the only one for its number: ``seed00`` is not allowed.
        """
        if self.card.kind == "builtin":
            return (0,) if self._plays(registry.task_spec(task)) else ()
        if self.card.kind == "python":
            return tuple(sorted(self.card.tasks.get(task, ())))
        names = [path.stem for path in (self.folder / task).glob(f"seed*{self._ending}")]
        numbered = [name for name in names if re.fullmatch(r"seed[0-9]+", name)]
        for name in numbered:
            if not _SEED_FILE.fullmatch(name):
                raise BundleError(
                    f"agent {self.name!r}: {task}/{name}{self._ending}: a training seed of at most nine "
                    f"digits is allowed, without leading zeros, such as seed{int(name[4:13])}{self._ending}"
                )
        return tuple(sorted(int(name[4:]) for name in numbered))

    def policy(self, spec: TaskSpec, train_seed: int = 0) -> Policy:
        """Load the policy for a task.

        Raises:
            BundleError: it has none for the task or training seed, or the weights do not fit.
            SandboxError: it needs a sandbox, and none works here.
        """
        match self.card.kind:
            case "builtin":
                return self._builtin(spec)
            case "network":
                return self._network(spec, train_seed)
            case "onnx":
                return self._graph(spec, train_seed)
            case "python":
                self._check_trained(spec.task, train_seed)
                return self._foreign(spec, train_seed, "python_runner", entry_point=self.card.entry_point)

    def chosen_policy(self, spec: TaskSpec, train_seed: int | None) -> Policy:
        """The policy of a training seed, by default of the first that there is; raises as `policy`."""
        if train_seed is None:
            train_seed = min(self.train_seeds(spec.task), default=0)
        return self.policy(spec, train_seed)

    def fingerprint(self, task: str, train_seed: int = 0) -> str:
        """Twelve hex digits that tell one policy of this agent from another."""
        match self.card.kind:
            case "builtin":
                content = str(self.card.builtin).encode()
            case "python":
                self._check_trained(task, train_seed)
                content = json.dumps([task, train_seed, self._digests()]).encode()
            case _:
                content = self._weights(task, train_seed).read_bytes()
        return hashlib.sha256(content).hexdigest()[:12]

    def check_distinct(self, task: str) -> None:
        """Refuse one policy under several training seeds: it was trained once.

        Policies of Python cannot be compared by content; what they do is compared when they have played.

        Raises:
            BundleError: two seeds have equal policies.
        """
        if self.card.kind in ("builtin", "python"):
            return
        seen: dict[str, int] = {}
        for seed in self.train_seeds(task):
            content = self._content(task, seed)
            if content in seen:
                raise BundleError(
                    f"agent {self.name!r}: {task}: training seeds {seen[content]} and {seed} are the same "
                    f"policy: every seed must be a training of its own"
                )
            seen[content] = seed

    def _content(self, task: str, train_seed: int) -> str:
        """A hash of what acts, whatever else is in the file."""
        path = self._weights(task, train_seed)
        return network_digest(path) if self.card.kind == "network" else digest(path)

    def _digests(self) -> dict[str, str]:
        return {name: digest(path) for name, path in bundle_files(self.folder).items()}

    def _builtin(self, spec: TaskSpec) -> Policy:
        try:
            return _BUILTIN[str(self.card.builtin)](spec)
        except UnknownNameError as error:
            raise BundleError(f"agent {self.name!r} does not play {spec.task}: {error}") from error

    def _network(self, spec: TaskSpec, train_seed: int) -> Policy:
        network = load_network(self._weights(spec.task, train_seed))
        layout = registry.definition_of(spec).layout
        sizes, expected = (
            (network.observation_size, network.action_size),
            (layout.observation.size, layout.action.size),
        )
        if sizes != expected:
            raise BundleError(
                f"agent {self.name!r}: {spec.task} has (O, A) = {expected}, its network {sizes}: train again"
            )
        blocks = tuple((block.name, block.shape) for block in layout.observation.present)
        if isinstance(network, Attention) and network.spec.observation != blocks:
            raise BundleError(
                f"agent {self.name!r}: {spec.task} shows the blocks {_listed(blocks)}, "
                f"its network declares {_listed(network.spec.observation)}"
            )
        return network

    def _graph(self, spec: TaskSpec, train_seed: int) -> Policy:
        file = self._weights(spec.task, train_seed).relative_to(self.folder).as_posix()
        check_graph(self.folder / file, spec, trust=self.trust)
        return self._foreign(spec, train_seed, "onnx_runner", file=file)

    def _foreign(self, spec: TaskSpec, train_seed: int, runner: str, **options: str | None) -> Policy:
        """A policy that acts in a process of its own."""
        return ForeignPolicy(spec, self.folder, train_seed, runner=runner, options=options, trust=self.trust)

    @property
    def _ending(self) -> str:
        """Of the files that hold its policies."""
        return {"network": ".safetensors", "onnx": ".onnx"}[self.card.kind]

    def _weights(self, task: str, train_seed: int) -> Path:
        self._check_trained(task, train_seed)
        path = self.folder / task / f"seed{train_seed}{self._ending}"
        check_regular(path)
        return path

    def _check_trained(self, task: str, train_seed: int) -> None:
        """Refuse what it was not trained for."""
        seeds = self.train_seeds(task)
        if not seeds:
            raise BundleError(
                f"agent {self.name!r} has no weights for {task}{hint(task, self.tasks) if self.tasks else ''}"
            )
        if train_seed not in seeds:
            raise BundleError(
                f"agent {self.name!r} has no training seed {train_seed} for {task}; there are: {seeds}"
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


def load_agent(name_or_path: str | Path, *, trust: bool = False) -> Agent:
    """Read a bundle: a bundled agent's name, or the path of a folder with ``agent.toml``.

    Args:
        name_or_path: which.
        trust: run its code without a sandbox where none is to be had; for agents of your own.

    Raises:
        UnknownNameError: neither; the message holds the nearest name.
        BundleError: ``agent.toml`` is refused.
    """
    if str(name_or_path) in agents():
        return _read(data_folder("agents") / name_or_path, trust)
    folder = Path(name_or_path)
    if (folder / "agent.toml").is_file():
        return _read(folder, trust)
    if folder.is_dir():
        raise BundleError(f"{folder} holds no agent.toml: it is not an agent bundle")
    raise UnknownNameError(f"no agent {str(name_or_path)!r}{hint(str(name_or_path), agents())}")


def digest(path: Path) -> str:
    """SHA-256 of a file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _listed(blocks: tuple[tuple[str, tuple[int, ...]], ...]) -> str:
    return ", ".join(f"{name} {shape}" for name, shape in blocks)


def _read(folder: Path, trust: bool) -> Agent:
    card = read_card(folder / "agent.toml")
    if card.builtin is not None and card.builtin not in _BUILTIN:
        raise BundleError(
            f"{folder / 'agent.toml'}: no built-in policy {card.builtin!r}{hint(card.builtin, _BUILTIN)}"
        )
    return Agent(card, folder, trust)
