"""How torch is told to compute while learning: in single precision on every processor, and quickly."""

from __future__ import annotations

import ctypes
import os
import sys

import torch

_MMAP_THRESHOLD, _TRIM_THRESHOLD = -3, -1
"""Of glibc's ``mallopt``."""
_LARGE = 1 << 30


def configure() -> None:
    """Let this process multiply matrices in float32 with AVX-512, and keep the memory it has touched.

    Products go through oneDNN, which uses AVX-512 on every brand of processor: on an AMD EPYC 2.2 times as
    fast as torch's default and as exact. The precision "medium" is what sends them there. It also allows
    bfloat16, which oneDNN takes where a processor has units for matrices (AMX) and which is wrong by up to
    1 % of an action: hence the limit on instructions, which must be set before the first product. The last
    bits of sums still depend on the processor. Freed arrays are kept for the next minibatch: the system
    would hand out the pages of large ones again, filled with zeros, every time.
    """
    os.environ.setdefault("ONEDNN_MAX_CPU_ISA", "AVX512_CORE")
    torch.set_float32_matmul_precision("medium")
    if not _is_exact():  # oneDNN was in use before, with all instructions
        torch.set_float32_matmul_precision("highest")
    if sys.platform == "linux":
        mallopt = getattr(ctypes.CDLL(None), "mallopt", None)  # musl has none
        if mallopt is not None:
            mallopt(_MMAP_THRESHOLD, _LARGE)
            mallopt(_TRIM_THRESHOLD, _LARGE)


def _is_exact() -> bool:
    """Whether products are of float32: with bfloat16, 1 + 2^-12 is 1."""
    ones = torch.ones(256, 256)
    return bool(((ones + 2**-12) @ ones == 256 + 2**-4).all())
