"""Seccomp: the system calls that arithmetic on one thread needs, and no others.

Python, NumPy and ONNX Runtime need what stands here (traced while they act, and while they fail). Every
other call is refused with EPERM: new processes, threads and programs, sockets of any kind, a hand on other
processes, the death signal, what the page cache holds, file locks, owners, modes and times of files, and
whatever a later kernel adds.
"""

from __future__ import annotations

import ctypes
import errno
import os
import platform
import struct

_ALLOWED = {
    # name: (x86_64, aarch64); None where the machine has no such call
    # the most frequent ones first: the kernel goes through them in this order
    "read": (0, 63), "write": (1, 64), "poll": (7, None), "ppoll": (271, 73), "futex": (202, 98),
    "clock_gettime": (228, 113), "mmap": (9, 222), "munmap": (11, 215), "madvise": (28, 233),
    "brk": (12, 214), "mprotect": (10, 226), "mremap": (25, 216),
    # files
    "open": (2, None), "openat": (257, 56), "openat2": (437, 437), "close": (3, 57),
    "close_range": (436, 436), "lseek": (8, 62), "readv": (19, 65), "writev": (20, 66), "pread64": (17, 67),
    "pwrite64": (18, 68), "stat": (4, None), "lstat": (6, None), "fstat": (5, 80), "newfstatat": (262, 79),
    "statx": (332, 291), "statfs": (137, 43), "fstatfs": (138, 44), "access": (21, None),
    "faccessat": (269, 48), "faccessat2": (439, 439), "readlink": (89, None), "readlinkat": (267, 78),
    "getdents": (78, None), "getdents64": (217, 61), "getcwd": (79, 17), "chdir": (80, 49),
    "ftruncate": (77, 46), "unlink": (87, None), "unlinkat": (263, 35), "rmdir": (84, None),
    "mkdir": (83, None), "mkdirat": (258, 34), "rename": (82, None), "renameat": (264, 38),
    "renameat2": (316, 276), "dup": (32, 23), "dup2": (33, None), "dup3": (292, 24), "pipe2": (293, 59),
    "select": (23, None), "pselect6": (270, 72),
    # time
    "gettimeofday": (96, 169), "time": (201, None), "times": (100, 153), "clock_getres": (229, 114),
    "nanosleep": (35, 101), "clock_nanosleep": (230, 115), "restart_syscall": (219, 128),
    # this process
    "getpid": (39, 172), "getppid": (110, 173), "gettid": (186, 178), "getuid": (102, 174),
    "geteuid": (107, 175), "getgid": (104, 176), "getegid": (108, 177), "getrusage": (98, 165),
    "getrlimit": (97, 163), "uname": (63, 160), "sysinfo": (99, 179), "getrandom": (318, 278),
    "getcpu": (309, 168), "sched_yield": (24, 124), "sched_getaffinity": (204, 123),
    "sched_getparam": (143, 121), "sched_getscheduler": (145, 120), "membarrier": (324, 283),
    "rt_sigaction": (13, 134), "rt_sigprocmask": (14, 135), "rt_sigreturn": (15, 139),
    "sigaltstack": (131, 132), "arch_prctl": (158, None), "set_tid_address": (218, 96),
    "set_robust_list": (273, 99), "get_robust_list": (274, 100), "rseq": (334, 293),
    "exit": (60, 93), "exit_group": (231, 94),
}  # fmt: skip
_ALLOWED_WITH = {
    # name: numbers as above, which argument, and what it may be
    "fcntl": ((72, 25), 1, (0, 1, 2, 3, 4, 1030)),  # descriptors' copies and flags; no locks, no owners
    "ioctl": ((16, 29), 1, (0x5401, 0x5451, 0x5421, 0x5413)),  # is it a terminal, close-on-exec, non-blocking
    "prlimit64": ((302, 261), 0, (0,)),  # of this process
}
_OWN_PROCESS_ONLY = {"tgkill": (234, 131)}
"""Allowed with this process's id first: `abort` needs it."""
_MACHINES = {"x86_64": (0, 0xC000003E), "aarch64": (1, 0xC00000B7)}
"""Column of the tables, and the kernel's name of the architecture."""
_FOREIGN_CALLS = 0x40000000
"""x86_64 has a second set of calls from this number on (x32)."""

_LOAD, _IF_EQUAL, _IF_AT_LEAST, _RETURN = 0x20, 0x15, 0x35, 0x06
_NUMBER, _ARCHITECTURE, _FIRST_ARGUMENT, _ARGUMENT_SIZE = 0, 4, 16, 8
_KILL, _REFUSE, _ALLOW = 0x80000000, 0x00050000 | errno.EPERM, 0x7FFF0000
_SET_SECCOMP, _FILTER = 22, 2


class _Program(ctypes.Structure):
    _fields_ = [("length", ctypes.c_ushort), ("code", ctypes.c_char_p)]


def allow_arithmetic() -> None:
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
    for numbers in _ALLOWED.values():
        if (number := numbers[column]) is not None:
            lines += [_line(_IF_EQUAL, number, skip_else=1), _line(_RETURN, _ALLOW)]
    conditions = [
        *_ALLOWED_WITH.values(),
        *((numbers, 0, (own_process,)) for numbers in _OWN_PROCESS_ONLY.values()),
    ]
    for numbers, argument, values in conditions:
        lines += [
            _line(_IF_EQUAL, numbers[column], skip_else=2 + 2 * len(values)),
            _line(_LOAD, _FIRST_ARGUMENT + _ARGUMENT_SIZE * argument),
            *(
                line
                for value in values
                for line in (_line(_IF_EQUAL, value, skip_else=1), _line(_RETURN, _ALLOW))
            ),
            _line(_RETURN, _REFUSE),
        ]
    return b"".join([*lines, _line(_RETURN, _REFUSE)])


def _line(operation: int, value: int, *, skip_if: int = 0, skip_else: int = 0) -> bytes:
    """One instruction; the skips are how many lines to leave out where a comparison holds or not."""
    return struct.pack("<HBBI", operation, skip_if, skip_else, value)
