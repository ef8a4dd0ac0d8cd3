"""Landlock: from now on this process reads some paths, and writes, signals and connects nowhere.

Three system calls, from the kernel's documentation (userspace-api/landlock); signals are refused since ABI 6,
Linux 6.12.
"""

from __future__ import annotations

import ctypes
import os
import stat
from collections.abc import Sequence

_CREATE_RULESET, _ADD_RULE, _RESTRICT_SELF = 444, 445, 446
_GIVE_VERSION = 1
_PATH_BENEATH = 1
_NEEDED = 6
_EVERY_FILE_RIGHT = (1 << 16) - 1
_EVERY_NET_RIGHT = 0b11
_ABSTRACT_SOCKETS_AND_SIGNALS = 0b11
_READ_FILE, _READ_FOLDER = 1 << 2, 1 << 3


class _Ruleset(ctypes.Structure):
    _fields_ = [("files", ctypes.c_uint64), ("net", ctypes.c_uint64), ("scoped", ctypes.c_uint64)]


class _PathBeneath(ctypes.Structure):
    _pack_ = 1
    _fields_ = [("allowed", ctypes.c_uint64), ("parent", ctypes.c_int32)]


def restrict(readable: Sequence[str]) -> None:
    """Refuse everything to this process but reading the given files and folders.

    Raises:
        OSError: the kernel has no Landlock, or one too old to refuse signals.
    """
    version = _call(_CREATE_RULESET, None, 0, _GIVE_VERSION)
    if version < _NEEDED:
        raise OSError(f"Landlock ABI {version}, {_NEEDED} is needed")
    wanted = _Ruleset(_EVERY_FILE_RIGHT, _EVERY_NET_RIGHT, _ABSTRACT_SOCKETS_AND_SIGNALS)
    rules = _call(_CREATE_RULESET, ctypes.byref(wanted), ctypes.sizeof(wanted), 0)
    for path in readable:
        opened = os.open(path, os.O_PATH | os.O_CLOEXEC)
        folder = stat.S_ISDIR(os.fstat(opened).st_mode)
        rule = _PathBeneath(_READ_FILE | _READ_FOLDER if folder else _READ_FILE, opened)
        _call(_ADD_RULE, rules, _PATH_BENEATH, ctypes.byref(rule), 0)
        os.close(opened)
    _call(_RESTRICT_SELF, rules, 0)
    os.close(rules)


def _call(number: int, *arguments: object) -> int:
    libc = ctypes.CDLL(None, use_errno=True)
    wide = [ctypes.c_long(value) if isinstance(value, int) else value for value in arguments]
    result = libc.syscall(ctypes.c_long(number), *wide)
    if result < 0:
        raise OSError(ctypes.get_errno(), f"landlock: {os.strerror(ctypes.get_errno())}")
    return result
