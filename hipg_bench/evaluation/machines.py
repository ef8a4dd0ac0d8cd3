"""On which machines rows come out the same to the last bit."""

from __future__ import annotations

import platform
from pathlib import Path

PROMISE = "x86-64 processors with FMA instructions, under Linux with glibc"
"""Where equal rows are promised. Elsewhere scores agree within their intervals, and rows do not."""


def why_rows_may_differ(cpuinfo: Path = Path("/proc/cpuinfo")) -> str | None:
    """Why rows made here need not be equal to those of other machines; None if they are.

    Without FMA, or with another C library, sine, cosine and exponential round otherwise, and walkers, whose
    contacts magnify the last bit, fall elsewhere.
    """
    if platform.machine() not in ("x86_64", "AMD64"):
        return f"this is a {platform.machine() or 'processor of unknown kind'}; equal rows need {PROMISE}"
    library = platform.libc_ver()[0]
    if library != "glibc":
        return f"the C library is {library or 'unknown'}; equal rows need {PROMISE}"
    described = cpuinfo.read_text().splitlines() if cpuinfo.exists() else []
    if not any(line.startswith("flags") and "fma" in line.split() for line in described):
        return f"this processor has no FMA instructions; equal rows need {PROMISE}"
    return None
