"""Files that a command is about to write: those of the user's are not written over."""

from __future__ import annotations

import os
from pathlib import Path

from hipg_bench.errors import HipgError

ARCHIVE, MARL_EVAL, PICTURE, VERDICTS = b"manifest.json", b'{"hipg_bench', b"hipg-bench", b'"p_improvement"'
"""What files of ours hold near their beginning: zips of `pack`, exports, plots, verdicts of `figures`."""
_HEAD = 4096


def check_free(path: Path, mark: bytes) -> None:
    """Refuse to write over a file that an earlier run of the same command did not make.

    Args:
        path: the file to be written.
        mark: what an earlier one holds in its first 4,096 bytes.

    Raises:
        HipgError: a link, a folder, a device or a file of something else is there.
    """
    if os.path.lexists(path) and not is_ours(path, mark):
        raise HipgError(
            f"{path} exists and was not written by this command, so it is not overwritten: "
            f"choose another name, or move it away"
        )


def is_ours(path: Path, mark: bytes) -> bool:
    """Whether it is a file, no link, that holds the mark near its beginning."""
    if path.is_symlink() or not path.is_file():
        return False
    with path.open("rb") as file:
        return mark in file.read(_HEAD)
