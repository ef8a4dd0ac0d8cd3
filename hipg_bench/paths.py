"""Where the suite's data lie: inside the installed wheel, or at the top of the checkout."""

from __future__ import annotations

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
