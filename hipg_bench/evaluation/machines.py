"""On which machines rows come out the same to the last bit."""

from __future__ import annotations

import hashlib
import math
import os
import platform
import struct
from collections.abc import Callable
from pathlib import Path

PROMISE = "x86-64 processors with FMA instructions, under Linux with glibc"
"""Where equal rows are promised. Elsewhere scores agree within their intervals, and rows do not."""

VALUES = 20_000
FUNCTIONS: dict[str, tuple[Callable[[float], float], float, float]] = {
    "acos": (math.acos, -1.0, 1.0),
    "asin": (math.asin, -1.0, 1.0),
    "atan2": (lambda x: math.atan2(x, 0.7), -5.0, 5.0),
    "cos": (math.cos, -7.0, 7.0),
    "exp": (math.exp, -40.0, 2.0),
    "log": (math.log, 0.01, 9.0),
    "log1p": (math.log1p, -0.999, 5.0),
    "pow": (lambda x: math.pow(x, 0.7), 0.01, 9.0),
    "sin": (math.sin, -7.0, 7.0),
    "tan": (math.tan, -1.5, 1.5),
}
"""What rules and MuJoCo call of the C library, and between which arguments it is tried."""
DIGESTS = {
    "acos": "4470086dfea73a89",
    "asin": "187fdaf9a2f4c12e",
    "atan2": "096bbad5e7f94777",
    "cos": "88e89ec201208125",
    "exp": "e7f51bfd1f2d91f4",
    "log": "1896bbccfd5956da",
    "log1p": "ce8ebde31361a2c0",
    "pow": "534777f49ffff19c",
    "sin": "3d3f7554094facde",
    "tan": "aa3be42b3368fc87",
}
"""Of the values of each function where rows are equal; found with glibc 2.36 on an AMD EPYC."""


def why_rows_may_differ(cpuinfo: Path = Path("/proc/cpuinfo")) -> str | None:
    """Why rows made here need not be equal to those of other machines; None if they are.

    Without FMA, or with another C library, sine, cosine and exponential round otherwise, and walkers, whose
    contacts magnify the last bit, fall elsewhere. GLIBC_TUNABLES can forbid the use of FMA to the library, so
    its values are looked at too.
    """
    if platform.machine() not in ("x86_64", "AMD64"):
        return f"this is a {platform.machine() or 'processor of unknown kind'}; equal rows need {PROMISE}"
    library = platform.libc_ver()[0]
    if library != "glibc":
        return f"the C library is {library or 'unknown'}; equal rows need {PROMISE}"
    described = cpuinfo.read_text().splitlines() if cpuinfo.exists() else []
    if not any(line.startswith("flags") and "fma" in line.split() for line in described):
        return f"this processor has no FMA instructions; equal rows need {PROMISE}"
    other = rounds_otherwise()
    if other:
        set_to = os.environ.get("GLIBC_TUNABLES")
        hint = f", and GLIBC_TUNABLES is set to {set_to!r}: try without it" if set_to else ""
        return f"{', '.join(other)} of the C library round otherwise here than with FMA instructions{hint}"
    return None


def rounds_otherwise() -> list[str]:
    """Names of the C library's functions whose values differ from the stored ones in any bit."""
    return [name for name in FUNCTIONS if digest(name) != DIGESTS[name]]


def digest(name: str) -> str:
    """16 hex digits that stand for `VALUES` values of a function, at arguments equally far apart."""
    function, low, high = FUNCTIONS[name]
    values = [function(low + (high - low) * k / (VALUES - 1)) for k in range(VALUES)]
    return hashlib.sha256(struct.pack(f"<{VALUES}d", *values)).hexdigest()[:16]
