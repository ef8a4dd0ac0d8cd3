"""Checkpoints: written whole with a checksum, and read back only if nothing happened to them."""

from __future__ import annotations

import pickle
import struct
from pathlib import Path
from typing import Any, cast

import torch

from hipg_bench.errors import ResumeError
from hipg_bench.paths import check_seal, replacing

_UNREADABLE = (
    OSError, EOFError, RuntimeError, ValueError, TypeError, LookupError, AttributeError, ArithmeticError,
    AssertionError, struct.error, pickle.UnpicklingError,
)  # fmt: skip
"""What PyTorch raises of files that are none of its."""


def save(path: Path, content: dict[str, Any]) -> None:
    """Write a checkpoint, whole or not at all."""
    with replacing(path, sealed=True) as temporary:
        torch.save(content, temporary)


def load(path: Path) -> dict[str, Any]:
    """Read a checkpoint; nothing but tensors and plain values is read.

    Raises:
        ResumeError: it is damaged.
    """
    check_seal(path)
    try:
        content = torch.load(path, weights_only=True)
    except _UNREADABLE as error:
        raise ResumeError(f"{path} is damaged, or is no checkpoint: {_first_line(error)}") from error
    if not isinstance(content, dict) or "settings" not in content or "iteration" not in content:
        raise ResumeError(f"{path} is no checkpoint of a training run")
    return cast(dict[str, Any], content)


def _first_line(error: Exception) -> str:
    return (str(error).strip().splitlines() or [type(error).__name__])[0]
