"""Where the suite's data lie, and how results are written so that nobody's are lost."""

from __future__ import annotations

import contextlib
import hashlib
import os
import shutil
import tempfile
from collections.abc import Generator, Sequence
from pathlib import Path

from hipg_bench.claims import Claim, claimed
from hipg_bench.errors import ResumeError

_PACKAGE = Path(__file__).resolve().parent


def data_folder(kind: str) -> Path:
    """Return the folder ``assets``, ``tasks`` or ``agents``.

    A wheel carries them as ``hipg_bench/data/<kind>``; in a checkout they stand beside the package.

    Raises:
        FileNotFoundError: neither place has the folder.
    """
    for folder in (_PACKAGE / "data" / kind, _PACKAGE.parent / kind):
        if folder.is_dir():
            return folder
    raise FileNotFoundError(
        f"no folder {kind!r} in {_PACKAGE / 'data'} or {_PACKAGE.parent}: reinstall hipg-bench"
    )


def is_installed() -> bool:
    """Whether the suite's data belong to an installed package, and not to a checkout."""
    return (_PACKAGE / "data").is_dir()


PARTIAL = ".hipg-bench-partial-"
"""What folders of half-written files are called, so that they can be told from users' files."""


@contextlib.contextmanager
def replacing(path: Path, *, sealed: bool = False) -> Generator[Path]:
    """Yield a temporary file to write to; it takes the place of ``path`` at the end.

    If the block fails or is interrupted, ``path`` stays as it was and nothing is left beside it. A killed
    process leaves a folder whose name starts with `PARTIAL`.

    Args:
        path: the file.
        sealed: write its checksum beside it too, for `check_seal`.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=PARTIAL, dir=path.parent) as folder:
        # the ending stays: encoders and savers choose the format by it
        temporary = Path(folder) / f"new{path.suffix}"
        temporary.touch()
        mode = temporary.stat().st_mode
        temporary.unlink()
        yield temporary
        temporary.chmod(mode)  # some savers make files that nobody else may read, whatever the umask
        if sealed:
            _seal(path, temporary)
        temporary.replace(path)


def write_text(path: Path, text: str, *, sealed: bool = False) -> None:
    """Write a whole file or nothing; see `replacing`."""
    with replacing(path, sealed=sealed) as temporary:
        temporary.write_text(text, encoding="utf-8")


def check_seal(path: Path) -> None:
    """See that a file which was written ``sealed`` is as it was written; without a checksum it is believed.

    Raises:
        ResumeError: it was changed or is damaged.
    """
    seal = _seal_of(path)
    if seal.exists() and _digest(path) not in seal.read_text(encoding="utf-8", errors="replace").split():
        raise ResumeError(
            f"{path} is damaged or was changed after it was written: its checksum is not in {seal.name}. "
            f"Restore it, or remove both files to begin it again"
        )


def _seal(path: Path, new: Path) -> None:
    """Note the checksums of a file and of the one about to take its place: a kill leaves either."""
    old = [_digest(path)] if path.exists() else []
    write_text(_seal_of(path), "\n".join([*old, _digest(new)]) + "\n")


def _seal_of(path: Path) -> Path:
    return path.with_name(f".{path.name}.sha256")


def _digest(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def remove_partial(folder: Path) -> None:
    """Remove what killed processes left half-written in a folder that no other process writes to."""
    for left in folder.glob(f"{PARTIAL}*"):
        shutil.rmtree(left, ignore_errors=True)


@contextlib.contextmanager
def output_folder(out: Path, record: str, results: Sequence[str], doing: str) -> Generator[Claim]:
    """Hold an output folder alone, and only if it is empty of others' files that would be overwritten.

    Args:
        out: the folder; made if it is missing.
        record: the file that says which run the folder belongs to; written by the caller.
        results: files and folders that the run writes beside it.
        doing: what another process may be doing there, for the error.

    Raises:
        ResumeError: another process holds it, or it has one of the ``results`` but no ``record``.
    """
    if not (out / record).exists():
        for name in results:
            if os.path.lexists(out / name):
                raise ResumeError(
                    f"{out} holds {name!r} but no {record}, so it is not of an earlier run, and nothing "
                    f"is overwritten: choose another --out"
                )
    with claimed(out, doing) as claim:
        yield claim


def new_folder(parent: Path, name: str) -> Path:
    """Make ``parent/name``, or with ``-2``, ``-3`` and so on after it, that did not exist before."""
    parent.mkdir(parents=True, exist_ok=True)
    folder, number = parent / name, 1
    while True:
        try:
            folder.mkdir()
            return folder
        except FileExistsError:
            number += 1
            folder = parent / f"{name}-{number}"
