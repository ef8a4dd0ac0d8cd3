"""Where an entry's agent comes from: a bundled agent, a folder, or a zip that strangers packed."""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import tempfile
from collections.abc import Generator
from pathlib import Path

from hipg_bench.errors import BoardError, BundleError
from hipg_bench.leaderboard.entry import Entry
from hipg_bench.policies.bundle import Agent, agents, load_agent
from hipg_bench.submissions import archive

BUNDLE = "bundle.zip"
"""The submission, in the entry's folder."""
NOT_NEEDED = "not needed"
"""The sandbox of agents that run no foreign code."""


@dataclasses.dataclass(frozen=True)
class Source:
    """An agent, unpacked.

    Attributes:
        agent: ready to play.
        bundle: the packed submission; None for agents that come with the benchmark.
    """

    agent: Agent
    bundle: Path | None

    @property
    def digest(self) -> str | None:
        """SHA-256 of the packed submission."""
        return hashlib.sha256(self.bundle.read_bytes()).hexdigest() if self.bundle else None

    @property
    def sandbox(self) -> str:
        """What keeps the agent apart while it plays."""
        if self.agent.card.tier in (None, 0):
            return NOT_NEEDED
        from hipg_bench.sandbox import choice

        return choice.NONE if self.agent.trust else choice.sandbox()


@contextlib.contextmanager
def opened(what: str | Path, place: Path | None = None, *, trust: bool = False) -> Generator[Source]:
    """Yield the agent of a bundled name, of a zip, or of a folder (which is packed first).

    Args:
        what: which.
        place: where a folder to unpack it in is made, by default among the system's temporary ones.
        trust: run its code without a sandbox where none is to be had.

    Raises:
        BundleError: the archive or what it holds is refused.
        UnknownNameError: nothing of that name.
    """
    if str(what) in agents():
        yield Source(load_agent(what, trust=trust), None)
        return
    with tempfile.TemporaryDirectory(prefix="hipg-entry-", dir=place) as folder:
        path = Path(what)
        if path.is_dir():
            load_agent(path)
            packed = Path(folder) / BUNDLE
            archive.pack(path, packed)
        elif path.is_file():
            packed = path
        else:
            # the message names the nearest bundled agent
            load_agent(what)
            raise BundleError(f"{what} is neither a file nor a folder")
        archive.unpack(packed, Path(folder) / "agent")
        agent = load_agent(Path(folder) / "agent", trust=trust)
        if agent.card.kind == "builtin":
            raise BundleError(f"{what}: kind = 'builtin' is for agents that come with the benchmark")
        if agent.name in agents():
            raise BundleError(
                f"{what}: the name {agent.name!r} belongs to an agent of the benchmark: choose another"
            )
        yield Source(agent, packed)


@contextlib.contextmanager
def reopened(folder: Path, entry: Entry, place: Path, *, trust: bool = False) -> Generator[Source]:
    """Yield the agent of an entry on the board, as it was submitted; it is unpacked in ``place``.

    Raises:
        BoardError: the submission is not the one that was entered.
    """
    if entry.bundle is None:
        with opened(entry.name, trust=trust) as source:
            yield source
        return
    packed = folder / BUNDLE
    if not packed.is_file():
        raise BoardError(f"{folder} holds no {BUNDLE}: get it from where the entry came from")
    if hashlib.sha256(packed.read_bytes()).hexdigest() != entry.bundle:
        raise BoardError(f"{packed} is not what was entered: its SHA-256 differs from entry.json's")
    with opened(packed, place, trust=trust) as source:
        yield source
