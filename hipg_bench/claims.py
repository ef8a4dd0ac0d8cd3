"""Claims: who works on an output folder, on one machine or on a shared disk.

A folder's claims are numbered files; the one with the highest number counts. Whoever finds it released or
stale adds the next number, whole and only if it does not exist yet (``link``, atomic on NFS too), so that of
many that try at once one succeeds. The file with the highest number is never removed, and the others are
removed from the lowest on: a process that adds a number too late, after the claim it found was followed by
others, does not see that claim any more, and knows. Owners renew theirs all the time; a claim is stale when
its process is dead, as seen on the same host, or when it was not renewed for `LEASE` seconds of the
observer's own clock: clocks of machines need not agree.
"""

from __future__ import annotations

import contextlib
import errno
import json
import os
import re
import secrets
import socket
import threading
import time
from collections.abc import Generator
from pathlib import Path
from typing import Any, NamedTuple, cast

from hipg_bench.errors import ResumeError

LEASE = 60.0
"""A claim that is not renewed for so many seconds is stale; owners renew theirs every quarter of it."""
CLAIM = ".hipg-bench-claim-"
"""How the names of claims begin."""
_RELEASED = "{}"
_NO_LINKS = (errno.EPERM, errno.ENOTSUP, errno.ENOSYS, errno.EMLINK)
"""What disks without hard links answer."""


class HeldError(ResumeError):
    """Another process works on the folder."""


class Owner(NamedTuple):
    """Who holds a folder.

    Attributes:
        host: machine.
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
    saw before.

    Args:
        folder: which.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._number: int | None = None
        self._seen: tuple[int, int, float] = (0, 0, 0.0)  # another one's number, time of renewal, since when
        self._stop = threading.Event()

    def take(self) -> bool:
        """Claim the folder, which is made if it is missing; return whether it was free."""
        self._folder.mkdir(parents=True, exist_ok=True)
        newest = _newest(self._folder)
        before = _identity(_path(self._folder, newest))
        if newest and not self._is_free(newest):
            return False
        if not self._add(newest + 1):
            return False
        if _identity(_path(self._folder, newest)) != before or _newest(self._folder) != newest + 1:
            self._mark_released(newest + 1)
            return False
        for older in _numbers(self._folder)[:-1]:
            _path(self._folder, older).unlink(missing_ok=True)
        for left in self._folder.glob(f"{CLAIM}*.new"):  # what the killed were about to add
            left.unlink(missing_ok=True)
        self._number, self._stop = newest + 1, threading.Event()
        threading.Thread(target=self._renew, args=(self._stop,), daemon=True).start()
        return True

    def release(self) -> None:
        """Give the folder back."""
        self._stop.set()
        if self._number is not None and self._is_newest():
            self._mark_released(self._number)
        self._number = None

    def check(self) -> None:
        """See that the folder is still held; to be called before results are written.

        Raises:
            ResumeError: another process took the folder, since this one was stopped for longer than `LEASE`.
        """
        if not self._is_newest():
            raise ResumeError(
                f"{self._folder}: this process stood still for more than {LEASE:.0f} s, and another process "
                f"has taken the folder over; nothing more is written here"
            )

    def _mark_released(self, number: int) -> None:
        temporary = self._folder / f"{CLAIM}{secrets.token_hex(8)}.new"
        temporary.write_text(_RELEASED, encoding="utf-8")
        with contextlib.suppress(FileNotFoundError):  # another one has the folder, and cleaned up
            temporary.replace(_path(self._folder, number))

    def _is_newest(self) -> bool:
        return _newest(self._folder) == self._number

    def _is_free(self, number: int) -> bool:
        """Whether a claim of somebody's is released or stale."""
        path = _path(self._folder, number)
        try:
            record, renewed = _read(path), path.stat().st_mtime_ns
        except FileNotFoundError:  # there is a newer one by now
            return False
        if record is not None and (not record or _is_dead(record)):
            return True
        now = time.monotonic()
        if self._seen[:2] != (number, renewed):
            self._seen = (number, renewed, now)
        return now - self._seen[2] > LEASE

    def _add(self, number: int) -> bool:
        """Add a claim of this process; return whether nobody else did."""
        record = json.dumps({"host": _host(), "pid": os.getpid(), "started": _started(os.getpid())})
        temporary = self._folder / f"{CLAIM}{secrets.token_hex(8)}.new"
        temporary.write_text(record, encoding="utf-8")
        try:
            os.link(temporary, _path(self._folder, number))
        except (FileExistsError, FileNotFoundError):  # FileNotFoundError: the one that succeeded cleaned up
            return False
        except OSError as error:
            if error.errno not in _NO_LINKS:
                raise
            return _create(_path(self._folder, number), record)
        finally:
            temporary.unlink(missing_ok=True)
        return True

    def _renew(self, stop: threading.Event) -> None:
        path = _path(self._folder, self._number or 0)
        while not stop.wait(LEASE / 4):
            with contextlib.suppress(OSError):  # the disk is away, or the claim is lost, which `check` finds
                os.utime(path)


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
    path = _path(folder, _newest(folder))
    try:
        record, age = _read(path), max(0.0, time.time() - path.stat().st_mtime)
    except FileNotFoundError:
        return None
    if not record:
        return None
    host = str(record["host"]).partition("/")[0]
    return Owner(host, int(record["pid"]), age, age < LEASE and not _is_dead(record))


def _path(folder: Path, number: int) -> Path:
    return folder / f"{CLAIM}{number}"


def _numbers(folder: Path) -> list[int]:
    """Numbers of a folder's claims, from the lowest on."""
    try:
        names = os.listdir(folder)
    except FileNotFoundError:
        return []
    found = (re.fullmatch(rf"{re.escape(CLAIM)}([0-9]+)", name) for name in names)
    return sorted(int(match[1]) for match in found if match)


def _newest(folder: Path) -> int:
    """The highest number, 0 if there is none; a listing may miss files that come and go meanwhile."""
    return max([0, *(_numbers(folder) or _numbers(folder))])


def _identity(path: Path) -> tuple[int, int] | None:
    """Which version of a file this is, None if there is none."""
    try:
        found = path.stat()
    except FileNotFoundError:
        return None
    return found.st_ino, found.st_mtime_ns


def _read(path: Path) -> dict[str, Any] | None:
    """What a claim says: nothing once it is released; None if it cannot be read."""
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
    except ValueError:
        return None
    known = isinstance(record, dict) and (record == {} or {"host", "pid", "started"} <= record.keys())
    return cast(dict[str, Any], record) if known else None


def _create(path: Path, text: str) -> bool:
    try:
        with path.open("x", encoding="utf-8") as file:
            file.write(text)
    except FileExistsError:
        return False
    return True


def _is_dead(record: dict[str, Any]) -> bool:
    """Whether the process is known to be dead, which is known of processes on this host only."""
    return record["host"] == _host() and _started(record["pid"]) != record["started"]


def _host() -> str:
    """This machine, and the container on it that has process numbers of its own."""
    try:
        return f"{socket.gethostname()}/{os.stat('/proc/self/ns/pid').st_ino}"
    except OSError:
        return f"{socket.gethostname()}/"


def _started(pid: int) -> str | None:
    """When a process started, in a form of the system's; None if it does not run."""
    try:
        stat = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8", errors="replace")
        state, *fields = stat.rpartition(")")[2].split()
        return None if state in "ZX" else fields[18]
    except OSError:
        pass
    if Path("/proc/self/stat").exists():
        return None
    try:  # systems without /proc tell no more than whether it runs
        os.kill(pid, 0)
    except ProcessLookupError:
        return None
    except PermissionError:
        pass
    return "running"
