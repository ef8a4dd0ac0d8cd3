"""The card of a bundle: what ``agent.toml`` says of an agent, of whom made it and of how it was trained."""

from __future__ import annotations

import stat
from pathlib import Path
from typing import Annotated, Literal

import pydantic

from hipg_bench.documents import read_toml
from hipg_bench.errors import BundleError, SpecError
from hipg_bench.spec import Params, parse

Kind = Literal["builtin", "network", "onnx", "python"]

TIERS: dict[str, int] = {"network": 0, "onnx": 1, "python": 2}
"""What may be submitted, by kind: declared networks, ONNX graphs, Python in a sandbox."""
TaskName = Annotated[str, pydantic.Field(pattern=r"^[a-z0-9][a-z0-9_-]{0,63}$")]
"""A task's name is used as a folder's."""
SeedNumber = Annotated[int, pydantic.Field(ge=0, le=999_999_999)]
_MOST_BYTES = 64 * 1024
"""A card is a page, not a book."""


class Training(Params):
    """How the weights came about; shown beside the score, never part of it.

    Attributes:
        env_steps: control steps of the environment per training seed, over all its worlds.
        hours: wall-clock time per training seed, h.
        hardware: processor, accelerators.
        framework: library and algorithm, e.g. ``Stable-Baselines3 2.7, PPO``.
        notes: what a reader should know: other observations, demonstrations, tuning.
    """

    env_steps: int | None = pydantic.Field(default=None, ge=0)
    hours: float | None = pydantic.Field(default=None, ge=0, allow_inf_nan=False)
    hardware: str = pydantic.Field(default="", max_length=300)
    framework: str = pydantic.Field(default="", max_length=300)
    notes: str = pydantic.Field(default="", max_length=2000)


class Card(Params):
    """What ``agent.toml`` says.

    Attributes:
        name: lower case, digits and underscores; the folder's name for bundled agents.
        summary: one sentence for lists.
        kind: ``builtin``: a policy of the package; ``network``: ``<task>/seed<k>.safetensors`` (tier 0);
            ``onnx``: ``<task>/seed<k>.onnx`` (tier 1); ``python``: code for the sandbox (tier 2).
        builtin: which policy of the package, where ``kind`` is ``builtin`` (and need not be said).
        entry_point: ``module:make_agent`` in the folder, where ``kind`` is ``python``.
        tasks: training seeds per task, where ``kind`` is ``python``; else the files tell.
        execution: ``centralised`` if agents know more than their own observations tell them.
        suite: the suite it is meant for.
        authors, license, link: whom to thank, what others may do with it, where to read on.
        training: how the weights came about.
    """

    name: str = pydantic.Field(pattern=r"^[a-z0-9][a-z0-9_]{0,63}$")
    summary: str = pydantic.Field(min_length=1, max_length=300)
    kind: Kind = "builtin"
    builtin: str | None = None
    entry_point: str | None = pydantic.Field(
        default=None, pattern=r"^[A-Za-z_]\w*(\.[A-Za-z_]\w*)*:[A-Za-z_]\w*$", max_length=200
    )
    tasks: dict[TaskName, tuple[SeedNumber, ...]] = pydantic.Field(
        default_factory=dict[str, tuple[int, ...]], max_length=100
    )
    execution: Literal["decentralised", "centralised"] = "decentralised"
    suite: str = pydantic.Field(default="hipg-1", pattern=r"^[a-z0-9-]{1,32}$")
    authors: str = pydantic.Field(default="", max_length=1000)
    license: str = pydantic.Field(default="", max_length=100)
    link: str = pydantic.Field(default="", max_length=500, pattern=r"^(https?://\S+)?$")
    training: Training = Training()

    @property
    def tier(self) -> int | None:
        """Submission tier: 0, 1 or 2; None for a policy of the package."""
        return TIERS.get(self.kind)


def read_card(path: Path) -> Card:
    """Read an ``agent.toml``.

    Raises:
        BundleError: it is refused; the message says which field and what is allowed.
    """
    check_regular(path)
    try:
        if path.stat().st_size > _MOST_BYTES:
            raise BundleError(f"{path}: at most {_MOST_BYTES} bytes are allowed")
        values = read_toml(path)
        if isinstance(values.get("training"), dict):  # by itself: its fields' nearest names are its own
            parse(Training, values["training"], f"{path}: [training]")
        card = parse(Card, values, str(path))
    except SpecError as error:
        raise BundleError(str(error)) from error
    except OSError as error:
        raise BundleError(f"{path}: {error.strerror}") from error
    _check_fields_agree(path, card)
    return card


def check_regular(path: Path) -> None:
    """Refuse links, pipes and devices before they are opened: reading one may never end.

    Raises:
        BundleError: it is no regular file.
    """
    try:
        mode = path.lstat().st_mode
    except OSError as error:
        raise BundleError(f"{path}: {error.strerror}") from error
    if not stat.S_ISREG(mode):
        raise BundleError(f"{path}: links, pipes and devices are not allowed, only files")


def _check_fields_agree(path: Path, card: Card) -> None:
    """Refuse a card whose fields belong to different kinds."""
    if (card.builtin is not None) != (card.kind == "builtin"):
        raise BundleError(f"{path}: exactly one of 'builtin' and 'kind' is allowed")
    python = card.kind == "python"
    for name, given in (("entry_point", card.entry_point is not None), ("tasks", bool(card.tasks))):
        if given and not python:
            raise BundleError(f"{path}: {name!r} belongs to kind = 'python', got kind = {card.kind!r}")
        if python and not given:
            example = {
                "entry_point": 'entry_point = "agent:make_agent"',
                "tasks": "[tasks] hazard_nav-4 = [0]",
            }
            raise BundleError(f"{path}: kind = 'python' needs {name!r}, such as {example[name]}")
    for task, seeds in card.tasks.items():
        if not seeds or len(set(seeds)) < len(seeds):
            raise BundleError(
                f"{path}: tasks.{task} = {list(seeds)}: one or more different seeds are allowed"
            )
