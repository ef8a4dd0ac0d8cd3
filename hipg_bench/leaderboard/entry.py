"""What the board says of an entry, `entry.json`: where its rows came from and who checked them."""

from __future__ import annotations

import datetime
from pathlib import Path
from typing import Any, Literal

import pydantic

from hipg_bench.documents import read_json
from hipg_bench.spec import Params, parse

SCHEMA = 1
"""Raised when a field of ``entry.json`` changes its meaning."""

Outcome = Literal["verified", "mismatch", "unsandboxed"]
"""What came of a verification: all rows are as claimed, some are not, or nobody was kept from cheating."""

Status = Literal["verified", "self-reported", "mismatch", "unsandboxed", "outdated"]
"""What the page shows: the outcome, ``self-reported`` before there is one, and ``outdated`` once the
hidden worlds are others than those of the verification."""


Execution = Literal["decentralised", "centralised"]


class Difference(Params):
    """A row that came out otherwise than claimed.

    Attributes:
        split, task, train_seed, world: which row.
        fields: what differs, name to (claimed, got); empty if only one side has the row, or the bytes alone
            differ.
        what: the difference in words.
    """

    split: str
    task: str
    train_seed: int
    world: int
    fields: dict[str, tuple[Any, Any]] = pydantic.Field(default_factory=dict[str, tuple[Any, Any]])
    what: str


class Verification(Params):
    """What a maintainer found who ran the entry again.

    Attributes:
        date: UTC, ISO 8601.
        outcome: see `Outcome`.
        commitment: SHA-256 of the salt that drew the hidden worlds.
        sandbox: what kept the agent apart: a backend's name, ``not needed`` where no foreign code is run, or
            ``none``.
        compared: rows played again and compared with those claimed.
        differing: how many of them differ.
        differences: the first of them.
        execution: ``decentralised`` where agents acted on what each alone sees, else ``centralised``.
        reasons: why it is not ``verified``, in words.
        versions: of the packages that played.
    """

    date: str
    outcome: Outcome
    commitment: str
    sandbox: str
    compared: int
    differing: int = 0
    differences: tuple[Difference, ...] = ()
    execution: Execution
    reasons: tuple[str, ...] = ()
    versions: dict[str, str] = pydantic.Field(default_factory=dict[str, str])


class Entry(Params):
    """An entry of the board.

    Attributes:
        schema_version: `SCHEMA`.
        name: of the agent, and of the folder.
        version: 1, and one more each time the agent is replaced.
        added: UTC, ISO 8601.
        suite: the frozen suite that was played.
        tier: 0 declared network, 1 ONNX, 2 Python; None for agents that come with the benchmark.
        bundle: SHA-256 of ``bundle.zip``; None for agents that come with the benchmark.
        policies: task to training seed to the policy's fingerprint.
        claimed: whether the rows on public worlds came with the submission; else the board played them.
        sandbox: what kept the agent apart while the board played: as in `Verification`.
        execution: what the submitter declares.
        privileged: whether it acts on the joint state; a reference then, never ranked.
        rows: path in the entry's folder to the SHA-256 of the rows in it, unpacked; those of hidden worlds
            are put there when the salt is revealed.
        verification: the maintainer's, once there is one.
    """

    schema_version: int = SCHEMA
    name: str = pydantic.Field(pattern=r"^[a-z0-9][a-z0-9_]{0,63}$")
    version: int = pydantic.Field(ge=1)
    added: str
    suite: str
    tier: int | None = pydantic.Field(ge=0, le=2)
    bundle: str | None
    policies: dict[str, dict[int, str]]
    claimed: bool
    sandbox: str
    execution: Execution
    privileged: bool = False
    rows: dict[str, str]
    verification: Verification | None = None

    def status(self, commitment: str | None) -> Status:
        """The badge, while ``commitment`` is that of the board's present hidden worlds."""
        if self.verification is None:
            return "self-reported"
        if self.verification.outcome == "verified" and self.verification.commitment != commitment:
            return "outdated"
        return self.verification.outcome


def now() -> str:
    """The present second, UTC, ISO 8601."""
    return datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")


def read_entry(folder: Path) -> Entry:
    """Read ``entry.json`` of an entry's folder.

    Raises:
        SpecError: it is damaged.
    """
    path = folder / "entry.json"
    return parse(Entry, read_json(path), str(path))
