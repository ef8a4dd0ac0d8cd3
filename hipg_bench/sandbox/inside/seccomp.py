"""Seccomp: system calls that an agent needs for nothing are refused with EPERM.

A policy is arithmetic on one thread. So no new processes, threads or programs, no sockets, no hand on other
processes, no memory outside the address space's limit, no change of a file's owner, mode or times (which
Landlock does not refuse).
"""

from __future__ import annotations

import ctypes
import errno
import os
import platform
import struct

_REFUSED = {
    # name: (x86_64, aarch64); None where the machine has no such call
    "clone": (56, 220), "fork": (57, None), "vfork": (58, None), "clone3": (435, 435),
    "execve": (59, 221), "execveat": (322, 281),
    "socket": (41, 198), "io_uring_setup": (425, 425), "io_uring_enter": (426, 426),
    "io_uring_register": (427, 427),
    "kill": (62, 129), "tkill": (200, 130), "rt_sigqueueinfo": (129, 138), "rt_tgsigqueueinfo": (297, 240),
    "pidfd_open": (434, 434), "pidfd_send_signal": (424, 424), "pidfd_getfd": (438, 438),
    "ptrace": (101, 117), "process_vm_readv": (310, 270), "process_vm_writev": (311, 271),
    "kcmp": (312, 272), "process_madvise": (440, 440), "process_mrelease": (448, 448),
    "move_pages": (279, 239), "migrate_pages": (256, 238),
    "setpriority": (141, 140), "ioprio_set": (251, 30), "sched_setaffinity": (203, 122),
    "sched_setscheduler": (144, 119), "sched_setparam": (142, 118), "sched_setattr": (314, 274),
    "memfd_create": (319, 279), "memfd_secret": (447, 447), "shmget": (29, 194), "semget": (64, 190),
    "msgget": (68, 186), "mq_open": (240, 180), "userfaultfd": (323, 282),
    "keyctl": (250, 219), "add_key": (248, 217), "request_key": (249, 218),
    "bpf": (321, 280), "perf_event_open": (298, 241), "fanotify_init": (300, 262),
    "open_by_handle_at": (304, 265),
    "unshare": (272, 97), "setns": (308, 268), "chroot": (161, 51), "pivot_root": (155, 41),
    "mount": (165, 40), "umount2": (166, 39), "open_tree": (428, 428), "move_mount": (429, 429),
    "fsopen": (430, 430), "fsconfig": (431, 431), "fsmount": (432, 432), "fspick": (433, 433),
    "mount_setattr": (442, 442),
    "chmod": (90, None), "fchmod": (91, 52), "fchmodat": (268, 53), "fchmodat2": (452, 452),
    "chown": (92, None), "fchown": (93, 55), "lchown": (94, None), "fchownat": (260, 54),
    "setxattr": (188, 5), "lsetxattr": (189, 6), "fsetxattr": (190, 7), "setxattrat": (463, 463),
    "removexattr": (197, 14), "lremovexattr": (198, 15), "fremovexattr": (199, 16),
    "removexattrat": (466, 466),
    "utime": (132, None), "utimes": (235, None), "futimesat": (261, None), "utimensat": (280, 88),
}  # fmt: skip
_OWN_PROCESS_ONLY = {"tgkill": (234, 131)}
"""Allowed with this process's id first: `abort` needs it."""
_OWN_AS_ZERO_ONLY = {"prlimit64": (302, 261)}
_MACHINES = {"x86_64": (0, 0xC000003E), "aarch64": (1, 0xC00000B7)}
"""Column of the tables, and the kernel's name of the architecture."""
_FOREIGN_CALLS = 0x40000000
"""x86_64 has a second set of calls from this number on (x32)."""

_LOAD, _IF_EQUAL, _IF_AT_LEAST, _RETURN = 0x20, 0x15, 0x35, 0x06
_NUMBER, _ARCHITECTURE, _FIRST_ARGUMENT = 0, 4, 16
_KILL, _REFUSE, _ALLOW = 0x80000000, 0x00050000 | errno.EPERM, 0x7FFF0000
_SET_SECCOMP, _FILTER = 22, 2


class _Program(ctypes.Structure):
    _fields_ = [("length", ctypes.c_ushort), ("code", ctypes.c_char_p)]


def refuse() -> None:
    """Install the filter on this process, for good.

    Raises:
        OSError: an unknown machine, or a kernel without seccomp.
    """
    if platform.machine() not in _MACHINES:
        raise OSError(f"no table of system calls for {platform.machine()!r}; there are: {list(_MACHINES)}")
    code = _filter(*_MACHINES[platform.machine()], own_process=os.getpid())
    program = _Program(len(code) // 8, code)
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.prctl(_SET_SECCOMP, _FILTER, ctypes.byref(program), 0, 0) != 0:
        raise OSError(ctypes.get_errno(), f"seccomp: {os.strerror(ctypes.get_errno())}")


def _filter(column: int, architecture: int, own_process: int) -> bytes:
    """The program that the kernel runs at each system call."""
    lines = [
        _line(_LOAD, _ARCHITECTURE),
        _line(_IF_EQUAL, architecture, skip_if=1),
        _line(_RETURN, _KILL),
        _line(_LOAD, _NUMBER),
        _line(_IF_AT_LEAST, _FOREIGN_CALLS, skip_else=1),
        _line(_RETURN, _KILL),
    ]
    for numbers in _REFUSED.values():
        if (number := numbers[column]) is not None:
            lines += [_line(_IF_EQUAL, number, skip_else=1), _line(_RETURN, _REFUSE)]
    for table, allowed in ((_OWN_PROCESS_ONLY, own_process), (_OWN_AS_ZERO_ONLY, 0)):
        for numbers in table.values():
            lines += [
                _line(_IF_EQUAL, numbers[column], skip_else=4),
                _line(_LOAD, _FIRST_ARGUMENT),
                _line(_IF_EQUAL, allowed, skip_if=1),
                _line(_RETURN, _REFUSE),
                _line(_RETURN, _ALLOW),
            ]
    return b"".join([*lines, _line(_RETURN, _ALLOW)])


def _line(operation: int, value: int, *, skip_if: int = 0, skip_else: int = 0) -> bytes:
    """One instruction; the skips are how many lines to leave out where a comparison holds or not."""
    return struct.pack("<HBBI", operation, skip_if, skip_else, value)
