"""The salt behind the hidden worlds: kept by the maintainer, its hash published beforehand.

``commitment.json`` on the board holds SHA-256 of the salt from the day it is drawn, so the maintainer cannot
choose worlds afterwards; once the salt is revealed, everybody can play the hidden worlds again.
"""

from __future__ import annotations

import os
import secrets
from pathlib import Path

from hipg_bench.documents import read_json
from hipg_bench.errors import BoardError
from hipg_bench.evaluation.seeds import commitment
from hipg_bench.leaderboard.entry import now
from hipg_bench.paths import write_text
from hipg_bench.spec import Params, parse

_BYTES = 32


class Commitment(Params):
    """A promise about hidden worlds.

    Attributes:
        suite: the suite whose worlds they are.
        sha256: of the salt.
        created: UTC, ISO 8601.
        salt: in hexadecimal, once revealed.
        revealed: when.
    """

    suite: str
    sha256: str
    created: str
    salt: str | None = None
    revealed: str | None = None


class Commitments(Params):
    """What ``commitment.json`` holds: the present promise, and those that were kept."""

    current: Commitment | None = None
    past: tuple[Commitment, ...] = ()

    @property
    def sha256(self) -> str | None:
        """Of the present salt."""
        return self.current.sha256 if self.current else None


def read_commitments(board: Path) -> Commitments:
    """What a board's folder promises; nothing, if it has no ``commitment.json``.

    Raises:
        SpecError: the file is damaged.
    """
    path = board / "commitment.json"
    if not path.exists():
        return Commitments()
    return parse(Commitments, read_json(path), str(path))


def new_salt(board: Path, file: Path, suite: str) -> Commitment:
    """Draw a salt into a file that only its owner can read, and publish its hash on the board.

    Raises:
        BoardError: the file exists, would lie under version control or on the board, or the present salt is
            not revealed yet.
    """
    commitments = read_commitments(board)
    if commitments.current is not None:
        raise BoardError(
            f"{board} is bound to the salt {commitments.current.sha256[:12]}... since "
            f"{commitments.current.created}: reveal that one first (`hipg-bench leaderboard salt reveal`)"
        )
    _refuse_inside(board, file)
    if file.exists():
        raise BoardError(f"{file} exists: a salt is never overwritten")
    salt = secrets.token_bytes(_BYTES)
    file.parent.mkdir(parents=True, exist_ok=True)
    with os.fdopen(os.open(file, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w") as opened:
        opened.write(salt.hex() + "\n")
    made = Commitment(suite=suite, sha256=commitment(salt), created=now())
    _write(board, commitments.model_copy(update={"current": made}))
    return made


def read_salt(board: Path, file: Path) -> bytes:
    """Read the salt that the board is bound to.

    Raises:
        BoardError: no such file, others can read it, it lies under version control or on the board, it
            holds no salt, or another one than was promised.
    """
    commitments = read_commitments(board)
    if commitments.current is None:
        raise BoardError(f"{board} is bound to no salt: draw one with `hipg-bench leaderboard salt new`")
    if not file.is_file():
        raise BoardError(
            f"no salt file {file}: the one that `hipg-bench leaderboard salt new` wrote is needed"
        )
    _refuse_inside(board, file)
    if file.stat().st_mode & 0o077:
        raise BoardError(f"{file} can be read by others: `chmod 600 {file}`, or draw a new salt if they have")
    try:
        salt = bytes.fromhex(file.read_text(encoding="ascii"))
    except ValueError as error:
        raise BoardError(f"{file} holds no salt: {2 * _BYTES} hexadecimal digits are expected") from error
    if len(salt) != _BYTES:
        raise BoardError(f"{file} holds {len(salt)} bytes: a salt has {_BYTES}")
    if commitment(salt) != commitments.current.sha256:
        raise BoardError(
            f"{file} is not the salt that {board} is bound to: "
            f"its SHA-256 is {commitment(salt)[:12]}..., promised was {commitments.current.sha256[:12]}..."
        )
    return salt


def private_folder(file: Path) -> Path:
    """Where rows of hidden worlds stay until the salt is revealed: beside the salt's file.

    ``<entry>/v<version>/hidden/<split>/episodes/<task>.jsonl.gz``
    """
    return file.with_name(f"{file.name}-rows")


def reveal_salt(board: Path, file: Path) -> Commitment:
    """Publish the present salt; a new one can be drawn then, and what was verified with this one is outdated.

    Rows of hidden worlds, which `private_folder` holds, can be published then too: `publish_rows`. A salt
    that is revealed already is returned as it was, so that publishing can be repeated.

    Raises:
        BoardError: as `read_salt`.
    """
    commitments = read_commitments(board)
    told = file.read_text(encoding="ascii", errors="replace").strip() if file.is_file() else None
    for past in commitments.past:
        if past.salt is not None and past.salt == told:
            return past
    salt = read_salt(board, file)
    if commitments.current is None:
        raise BoardError(f"{board} was revealed meanwhile")
    kept = commitments.current.model_copy(update={"salt": salt.hex(), "revealed": now()})
    _write(board, Commitments(past=(*commitments.past, kept)))
    return kept


def _write(board: Path, commitments: Commitments) -> None:
    write_text(board / "commitment.json", commitments.model_dump_json(indent=2) + "\n")


def _refuse_inside(board: Path, file: Path) -> None:
    """A salt under version control, or on the board, is published sooner or later."""
    for folder in file.resolve().parents:
        if folder == board.resolve() or (folder / ".git").exists():
            raise BoardError(f"{file} lies in {folder}, which is published: keep the salt outside of it")
