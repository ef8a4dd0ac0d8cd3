"""How torch is told to compute while learning: the same numbers, sooner."""

from __future__ import annotations

import ctypes
import sys

import torch

_MMAP_THRESHOLD, _TRIM_THRESHOLD = -3, -1
"""Of glibc's ``mallopt``."""
_LARGE = 1 << 30


def prepare() -> None:
    """Let this process multiply matrices with all the CPU has, and keep the memory it has touched.

    Products of float32 go through oneDNN, which uses AVX-512 on every brand of CPU: on an AMD EPYC 2.2 times
    as fast as the default and as exact. Where a CPU has units for matrices (AMX), oneDNN rounds their
    inputs to bfloat16. Freed arrays are kept for the next minibatch: the system would hand out the pages
    of large ones anew, filled with zeros, every time.
    """
    torch.set_float32_matmul_precision("medium")
    if sys.platform == "linux":
        mallopt = getattr(ctypes.CDLL(None), "mallopt", None)  # musl has none
        if mallopt is not None:
            mallopt(_MMAP_THRESHOLD, _LARGE)
            mallopt(_TRIM_THRESHOLD, _LARGE)
