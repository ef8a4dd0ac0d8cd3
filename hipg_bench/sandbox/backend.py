"""What a way to lock a child in consists of, and what every child is given, however it is locked in."""

from __future__ import annotations

import dataclasses
import sys
import sysconfig
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

INSIDE = Path(__file__).resolve().parent / "inside"
ENVIRONMENT: Mapping[str, str] = {
    "PATH": "/usr/bin:/bin",
    "HOME": "/tmp",
    "LC_ALL": "C.UTF-8",
    "PYTHONHASHSEED": "0",  # the same order of a set in every run
    **{f"{library}_NUM_THREADS": "1" for library in ("OMP", "OPENBLAS", "MKL", "NUMEXPR", "NUMBA")},
}  # fmt: skip
"""The child's whole environment."""

_START = """
import importlib.util as util, sys
folder = sys.argv[1]
first = folder + "/__init__.py"
spec = util.spec_from_file_location("hipg_inside", first, submodule_search_locations=[folder])
sys.modules["hipg_inside"] = util.module_from_spec(spec)
spec.loader.exec_module(sys.modules["hipg_inside"])
from hipg_inside.main import main
main()
"""


@dataclasses.dataclass(frozen=True)
class Start:
    """How to start one child.

    Attributes:
        command: the program and its arguments.
        setup: what the child is told of its confinement and its paths.
    """

    command: list[str]
    setup: dict[str, Any]


Backend = Callable[[Path], Start]
"""Takes the submission's folder."""


def interpreter() -> Path:
    """The Python that this one is, outside its virtual environment."""
    return Path(getattr(sys, "_base_executable", sys.executable)).resolve()


def packages() -> list[Path]:
    """Folders with installed packages; what an editable installation adds is not among them."""
    paths = {Path(sysconfig.get_path(kind)).resolve() for kind in ("purelib", "platlib")}
    return sorted(path for path in paths if path.is_dir())


def system() -> list[Path]:
    """The Python installation and the system's libraries."""
    paths = [Path(path) for path in ("/usr/lib", "/usr/lib64", "/usr/local/lib", "/lib", "/lib64")]
    return [path for path in (*paths, Path(sys.base_prefix).resolve()) if path.is_dir()]


def python(inside: Path) -> list[str]:
    """Start the child's program, which lies in the folder ``inside``.

    The environment is ours, so it need not be ignored as ``-I`` does; else ``-s -P -S`` does the same.
    """
    return [str(interpreter()), "-s", "-P", "-S", "-B", "-u", "-c", _START, str(inside)]


def open_door(folder: Path) -> Start:
    """No sandbox: for one's own agents."""
    return Start(
        python(INSIDE),
        {
            "folder": str(folder.resolve()),
            "packages": [str(path) for path in packages()],
            "readable": None,
            "syscalls": False,
        },
    )
