"""Python processes that import nothing, and read no settings, from the folder a user happens to work in.

A bundle of a stranger's, or a user's own ``random.py``, may lie in that folder. Python looks there first for
the modules of ``python -m`` and ``python -c``, Numba and Matplotlib for their settings, and Numba's say where
machine code is loaded from. All processes of this package are started with what is here; the sandbox, whose
processes must not even know this one's environment, has rules of its own (`hipg_bench.sandbox`).
"""

from __future__ import annotations

import contextlib
import importlib
import math
import os
import sys
from collections.abc import Generator

_SETTINGS = (".numba_config.yaml", "matplotlibrc")
"""Files of the working folder that libraries read when they are imported."""


def python(*arguments: str) -> list[str]:
    """The command that starts this Python without the working folder on its path."""
    return [sys.executable, "-P", *arguments]


def environment(**changes: str) -> dict[str, str]:
    """This process's environment for a child; the child's own children leave the folder out too.

    Entries of ``PYTHONPATH`` that are not absolute are left out: they depend on the working folder.
    """
    own = {**os.environ, "PYTHONSAFEPATH": "1", **changes}
    absolute = [path for path in own.pop("PYTHONPATH", "").split(os.pathsep) if os.path.isabs(path)]
    return {**own, "PYTHONPATH": os.pathsep.join(absolute)} if absolute else own


def usable_cores() -> int:
    """Cores that this process may use: those it is bound to, as far as its container's quota goes."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(1, min(cores, _quota() or cores))


def _quota() -> int | None:
    """Cores' worth of time that a container may use, rounded up; None where there is no limit."""
    old = "/sys/fs/cgroup/cpu/cpu.cfs_{}_us"
    text = _read("/sys/fs/cgroup/cpu.max") or f"{_read(old.format('quota'))} {_read(old.format('period'))}"
    try:
        quota, period = (float(part) for part in text.split())
    except ValueError:  # no file, or "max": no limit
        return None
    return math.ceil(quota / period) if quota > 0 and period > 0 else None


def _read(path: str) -> str:
    try:
        with open(path, encoding="ascii") as file:
            return file.read().strip()
    except OSError:
        return ""


def leave_out_the_working_folder() -> None:
    """Apply the rules to this process and to all that it and its libraries start; for programs only.

    To be called before anything but the standard library is imported.
    """
    os.environ["PYTHONSAFEPATH"] = "1"
    if "PYTHONPATH" in os.environ:
        os.environ["PYTHONPATH"] = environment().get("PYTHONPATH", "")
    if not sys.flags.safe_path and sys.path[:1] == [_working_folder()]:
        del sys.path[0]  # ``python -m`` put it there
    sys.path[:] = [path for path in sys.path if os.path.isabs(path)]
    if any(os.path.isfile(name) for name in _SETTINGS):
        with _elsewhere():
            importlib.import_module("matplotlib")
            from numba.core import config
        setattr(config, "_config_fname", os.devnull)  # noqa: B010 (it is read again at every compilation)


@contextlib.contextmanager
def children_leave_out_the_working_folder() -> Generator[None]:
    """Apply the rules for a moment to processes that libraries start, in a program of a user's."""
    before = os.environ.get("PYTHONSAFEPATH")
    os.environ["PYTHONSAFEPATH"] = "1"
    try:
        yield
    finally:
        if before is None:
            del os.environ["PYTHONSAFEPATH"]
        else:
            os.environ["PYTHONSAFEPATH"] = before


def _working_folder() -> str:
    try:
        return os.getcwd()
    except FileNotFoundError:  # it was removed
        return ""


@contextlib.contextmanager
def _elsewhere() -> Generator[None]:
    """Work in the root folder for a moment."""
    here = os.open(".", os.O_RDONLY)
    try:
        os.chdir("/")
        yield
    finally:
        os.fchdir(here)
        os.close(here)
