"""Where the suite's data lie: inside the installed wheel, or at the top of the checkout."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Generator
from pathlib import Path

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


@contextlib.contextmanager
def replacing(path: Path) -> Generator[Path]:
    """Yield a temporary file beside ``path`` to write to; it takes the place of ``path`` at the end.

    If the block fails or is interrupted, ``path`` stays as it was and nothing is left beside it.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    # the ending stays last: encoders and savers choose the format by it
    temporary = path.with_name(f".{path.stem}-{os.getpid()}{path.suffix}")
    try:
        yield temporary
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """Write a whole file or nothing."""
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
