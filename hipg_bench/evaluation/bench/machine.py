"""On what, and with what, something was measured."""

from __future__ import annotations

import importlib.metadata
import os
import platform
from pathlib import Path
from typing import Any

from hipg_bench.processes import usable_cores

_PACKAGES = (
    "hipg-bench", "mujoco", "numpy", "scipy", "torch", "gymnasium", "pettingzoo", "dm-env", "torchrl",
    "tensordict", "stable-baselines3", "ray", "imageio-ffmpeg",
)  # fmt: skip


def machine() -> dict[str, Any]:
    """What a reader must know to make sense of a time; ``load`` is how busy it was before."""
    return {
        "processor": _processor(),
        "cores": usable_cores(),
        "memory_gb": round(_memory() / 1e9, 1),
        "system": platform.platform(),
        "python": platform.python_version(),
        "load": round(os.getloadavg()[0], 2),
    }


def versions() -> dict[str, str]:
    """Of the packages that are installed."""
    found: dict[str, str] = {}
    for package in _PACKAGES:
        try:
            found[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            continue
    return found


def _processor() -> str:
    """The model's name; the standard library does not know it on Linux."""
    described = Path("/proc/cpuinfo")
    if described.exists():
        names = [line for line in described.read_text().splitlines() if line.startswith("model name")]
        if names:
            return names[0].split(":", 1)[1].strip()
    return platform.processor() or platform.machine()


def _memory() -> float:
    """Bytes."""
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
