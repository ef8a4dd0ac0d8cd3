"""Claims: who works on an output folder, on one machine or on a shared disk.

A claim is a file that one process can create (``O_EXCL``, which NFS keeps), with the host, the process and a
token in it. Its owner renews it; a claim is free again when its process is dead, as seen on the same host, or
when nothing renewed it for `LEASE` seconds of the observer's own clock.
"""

from __future__ import annotations

import contextlib
import os
import socket
import time
from collections.abc import Generator
from pathlib import Path
from typing import NamedTuple

from filelock import SoftFileLease, Timeout

from hipg_bench.errors import ResumeError

CLAIM = ".hipg-bench.claim"
"""The file in an output folder that its process holds."""
LEASE = 60.0
"""A claim that is not renewed for so many seconds is free; owners renew theirs every third of it."""


class Owner(NamedTuple):
    """Who holds a folder.

    Attributes:
        host: machine, as it calls itself.
        pid: process.
        age: seconds since the claim was renewed, by this machine's clock and the disk's.
        alive: whether it was renewed in time, and its process is not known to be dead.
    """

    host: str
    pid: int
    age: float
    alive: bool


class Claim:
    """A claim on one folder.

    Keep one object to notice that another machine's claim is stale: it compares what it sees now with what it
    saw `LEASE` seconds ago.

    Args:
        folder: which.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._lease = SoftFileLease(folder / CLAIM, lease_duration=LEASE, poll_interval=0.05)

    def take(self) -> bool:
        """Claim the folder; return whether it was free."""
        self._folder.mkdir(parents=True, exist_ok=True)
        try:
            self._lease.acquire(timeout=0)
        except Timeout:
            return False
        return True

    def release(self) -> None:
        """Give the folder back."""
        self._lease.release()

    def check(self) -> None:
        """See that the folder is still held; to be called before results are written.

        Raises:
            ResumeError: another process took the folder, since this one was stopped for longer than `LEASE`.
        """
        owner = self._lease.owner
        if owner is None or owner.token != self._lease.token:
            raise ResumeError(
                f"{self._folder}: this process stood still for more than {LEASE:.0f} s, and another process "
                f"has taken the folder over; nothing more is written here"
            )


class HeldError(ResumeError):
    """Another process works on the folder."""


@contextlib.contextmanager
def claimed(folder: Path, doing: str) -> Generator[Claim]:
    """Hold a folder, alone.

    Args:
        folder: which; made if it is missing.
        doing: what another process may be doing there, for the error.

    Raises:
        HeldError: another process holds it.
    """
    claim = Claim(folder)
    if not claim.take():
        who = owner(folder)
        where = f" (process {who.pid} on {who.host})" if who else ""
        raise HeldError(f"{folder}: another process is {doing} here{where}")
    try:
        yield claim
    finally:
        claim.release()


def owner(folder: Path) -> Owner | None:
    """Who holds a folder, or did when it was killed; None if nobody does. Nothing is changed."""
    path = folder / CLAIM
    found = SoftFileLease(path, lease_duration=LEASE).owner
    try:
        age = time.time() - path.stat().st_mtime
    except FileNotFoundError:
        return None
    if found is None:
        return None
    # after a question mark stands the container, whose processes cannot be seen from here
    host, container, _ = found.hostname.partition("?")
    dead = not container and host == socket.gethostname() and not _runs(found.pid)
    return Owner(host, found.pid, max(0.0, age), age < LEASE and not dead)


def _runs(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        pass
    return True
