"""Shutting the door from inside, before any code of others is loaded. None of it can be undone."""

from __future__ import annotations

import ctypes
import os
import resource
import signal
import struct
from collections.abc import Mapping
from typing import Any

from . import landlock, seccomp

_FILE_SIZE = 16 << 20
_OPEN_FILES = 128
_PROCESSOR_SECONDS = 4 * 3600
"""Longest time that a child whose parent is gone may go on; the parent's clocks are far stricter."""
_CAPABILITY_VERSION = 0x20080522
_SET_DEATH_SIGNAL, _SET_NO_NEW_PRIVILEGES = 1, 38


def shut(setup: Mapping[str, Any]) -> None:
    """Lock this process in as ``setup`` says.

    Args:
        setup: ``memory``, address space in bytes; ``readable``, paths that may be read or None for all that
            is there; ``syscalls``, whether all system calls but those of arithmetic are refused.

    Raises:
        OSError: the kernel refuses to.
    """
    _limit(setup["memory"])
    libc = ctypes.CDLL(None, use_errno=True)
    libc.prctl(_SET_DEATH_SIGNAL, signal.SIGKILL, 0, 0, 0)
    libc.prctl(_SET_NO_NEW_PRIVILEGES, 1, 0, 0, 0)
    if setup["readable"] is not None:
        landlock.restrict(setup["readable"])
    if setup["syscalls"]:
        _drop_capabilities(libc)
        seccomp.allow_arithmetic()


def _drop_capabilities(libc: ctypes.CDLL) -> None:
    """Where root runs this, be root in name only."""
    header = struct.pack("<Ii", _CAPABILITY_VERSION, 0)
    if libc.capset(header, bytes(24)) != 0:
        raise OSError(ctypes.get_errno(), f"capabilities: {os.strerror(ctypes.get_errno())}")


def _limit(memory: int) -> None:
    for what, most in (
        (resource.RLIMIT_AS, memory),
        (resource.RLIMIT_CORE, 0),
        (resource.RLIMIT_FSIZE, _FILE_SIZE),
        (resource.RLIMIT_NOFILE, _OPEN_FILES),
        (resource.RLIMIT_CPU, _PROCESSOR_SECONDS),
        (resource.RLIMIT_MEMLOCK, 0),
    ):
        allowed = resource.getrlimit(what)[1]
        if allowed != resource.RLIM_INFINITY:
            most = min(most, allowed)
        resource.setrlimit(what, (most, most))
