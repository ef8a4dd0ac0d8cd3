"""Landlock and seccomp: for machines without user namespaces. The child locks itself in, and writes nowhere.

It hides less than bubblewrap: whether a path exists and how large a file is can be seen, its content not.
"""

from __future__ import annotations

from pathlib import Path

from hipg_bench.sandbox.backend import INSIDE, Start, packages, python, system


def start(folder: Path) -> Start:
    """A plain child that may read Python, the installed packages and the submission's folder."""
    devices = [Path("/dev/null"), Path("/dev/urandom")]
    readable = [*system(), *packages(), INSIDE, folder.resolve(), *devices]
    return Start(
        python(INSIDE),
        {
            "folder": str(folder.resolve()),
            "packages": [str(path) for path in packages()],
            "readable": [str(path) for path in readable],
            "syscalls": True,
        },
    )
