"""Rows as the board keeps them: packed, hashed, and compared byte for byte."""

from __future__ import annotations

import gzip
import hashlib
import json
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from hipg_bench.errors import BoardError
from hipg_bench.leaderboard.entry import Difference
from hipg_bench.paths import replacing

Key = tuple[int, int]
"""A row's training seed and world."""

MOST_BYTES = 64_000_000
"""Of the rows of one task."""
_SHOWN, _MOST_FIELDS = 60, 12
"""Characters of a value, and fields of a row, that are kept in a difference."""


def pack(text: bytes, path: Path) -> str:
    """Write rows, packed the same way each time; return the SHA-256 of the rows."""
    with replacing(path) as temporary:
        temporary.write_bytes(gzip.compress(text, mtime=0))
    return hashlib.sha256(text).hexdigest()


def unpack(path: Path) -> bytes:
    """Read rows.

    Raises:
        BoardError: the file is damaged, or holds more than rows can take.
    """
    try:
        with gzip.open(path) as file:
            text = file.read(MOST_BYTES + 1)
    except (OSError, EOFError, zlib.error) as error:
        raise BoardError(f"{path} is damaged: {error}") from error
    if len(text) > MOST_BYTES:
        raise BoardError(f"{path}: at most {MOST_BYTES} bytes of rows are allowed")
    return text


def parse_rows(text: bytes, where: str) -> list[dict[str, Any]]:
    """The rows, in the order in which they stand.

    Raises:
        BoardError: a line is not a JSON object with a training seed and a world.
    """
    return [_parse(line, where) for line in text.splitlines()]


def compare(split: str, task: str, claimed: bytes, got: bytes) -> list[Difference]:
    """The rows whose bytes differ, by training seed and world.

    Raises:
        BoardError: what is claimed is not rows.
    """
    theirs, ours = _index(claimed, f"{split}/{task} as claimed"), _index(got, f"{split}/{task}")
    return [
        Difference(
            split=split, task=task, train_seed=seed, world=world, **_say(theirs.get(key), ours.get(key))
        )
        for key in sorted({*theirs, *ours})
        if theirs.get(key) != ours.get(key)
        for seed, world in [key]
    ]


def _index(text: bytes, where: str) -> dict[Key, bytes]:
    lines = text.splitlines()
    rows = [_parse(line, where) for line in lines]
    return {(row["train_seed"], row["world"]): line for row, line in zip(rows, lines, strict=True)}


def _parse(line: bytes, where: str) -> dict[str, Any]:
    try:
        row = json.loads(line)
    except ValueError as error:
        raise BoardError(f"{where}: a line is not JSON: {line[:_SHOWN]!r}") from error
    if not isinstance(row, dict) or not all(type(row.get(name)) is int for name in ("train_seed", "world")):
        raise BoardError(f"{where}: a line is no row with a train_seed and a world: {line[:_SHOWN]!r}")
    return row


def _say(claimed: bytes | None, got: bytes | None) -> Mapping[str, Any]:
    """How two rows differ: the fields, and in words."""
    if claimed is None or got is None:
        return {"what": "not claimed" if claimed is None else "claimed, but there is no such world"}
    a, b = json.loads(claimed), json.loads(got)
    names = [name for name in sorted({*a, *b}) if a.get(name) != b.get(name)][:_MOST_FIELDS]
    said = (f"{_short(name)}: claimed {_short(a.get(name))}, got {_short(b.get(name))}" for name in names)
    return {
        "fields": {_short(name): (_plain(a.get(name)), _plain(b.get(name))) for name in names},
        "what": "; ".join(said) or "the same numbers, written otherwise",
    }


def _plain(value: object) -> object:
    """A number as it is, anything else as short text: a claim may hold anything."""
    return value if value is None or isinstance(value, (int, float)) else _short(value)


def _short(value: object) -> str:
    text = value if isinstance(value, str) else repr(value)
    return text if len(text) <= _SHOWN else text[:_SHOWN] + "..."
