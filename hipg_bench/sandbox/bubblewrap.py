"""Bubblewrap: namespaces of its own. The child sees no file, process or network but what is listed here."""

from __future__ import annotations

import shutil
from pathlib import Path

from hipg_bench.errors import SandboxError
from hipg_bench.sandbox.backend import ENVIRONMENT, INSIDE, Start, packages, python, system

_FOLDER, _INSIDE = Path("/agent"), Path("/hipg_inside")
_SPACE = 64 << 20
_DEVICES = ("/dev/null", "/dev/zero", "/dev/random", "/dev/urandom")
_FACTS = ("/proc/cpuinfo", "/proc/meminfo")
"""Read by numerical libraries; the rest of /proc is not there."""
_NOBODY = "65534"


def start(folder: Path) -> Start:
    """Everything read-only but 64 MB of /tmp; new user, process, network, mount, IPC and host-name spaces.

    Raises:
        SandboxError: bwrap is not installed.
    """
    program = shutil.which("bwrap")
    if program is None:
        raise SandboxError("bwrap is not installed: apt install bubblewrap")
    seen = [path for path in system() if not path.is_symlink()] + packages()
    links = [path for path in system() if path.is_symlink()]
    command = [
        program, "--unshare-all", "--die-with-parent", "--new-session", "--clearenv", "--cap-drop", "ALL",
        "--uid", _NOBODY, "--gid", _NOBODY, "--hostname", "agent",
        *(part for name, value in ENVIRONMENT.items() for part in ("--setenv", name, value)),
        "--size", str(_SPACE), "--tmpfs", "/tmp",  # first: an environment may lie in /tmp
        *(part for path in seen for part in ("--ro-bind", str(path), str(path))),
        *(part for path in links for part in ("--symlink", str(path.readlink()), str(path))),
        *(part for path in _DEVICES for part in ("--dev-bind", path, path)),
        *(part for path in _FACTS for part in ("--ro-bind-try", path, path)),
        "--ro-bind-try", "/etc/ld.so.cache", "/etc/ld.so.cache",
        "--ro-bind", str(folder.resolve()), str(_FOLDER), "--ro-bind", str(INSIDE), str(_INSIDE),
        "--remount-ro", "/", "--chdir", "/tmp",
        *python(_INSIDE),
    ]  # fmt: skip
    return Start(
        command,
        {
            "folder": str(_FOLDER),
            "packages": [str(path) for path in packages()],
            "readable": None,
            "syscalls": True,
        },
    )
