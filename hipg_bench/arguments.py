"""Arguments from outside, as Gymnasium's, PettingZoo's and NumPy's users hand them over: taken or refused."""

from __future__ import annotations

import secrets
from typing import Any

import numpy as np

from hipg_bench.errors import ActionError, SpecError, abbreviate

MOST_SEED = 2**64 - 1
"""Largest seed."""
MOST_EPISODE = 2**53 - 1
"""Largest episode id: a state row keeps it as a float."""


def whole(value: Any, what: str, low: int, high: int | None = None) -> int:
    """Return a whole number as Python's int; NumPy's integers, also as arrays of one number, are allowed.

    Args:
        value: what was handed over.
        what: its name, with the task's, for the error.
        low: the smallest that is allowed.
        high: the largest, or None.

    Raises:
        SpecError: it is no whole number, or out of range.
    """
    if isinstance(value, np.ndarray) and value.ndim == 0:
        value = value[()]
    allowed = f"a whole number from {low} on" if high is None else f"a whole number in {low}..{high}"
    if not isinstance(value, int | np.integer):
        raise SpecError(f"{what} = {abbreviate(value)} is refused: {allowed} is allowed")
    if value < low or (high is not None and value > high):
        raise SpecError(f"{what} = {abbreviate(value)} is refused: {allowed} is allowed")
    return int(value)


def seed_or_entropy(seed: Any, what: str) -> int:
    """Return a seed, or for None one from the system's entropy, another each time.

    Raises:
        SpecError: neither None nor a whole number in 0..2^64 - 1.
    """
    return secrets.randbits(63) if seed is None else whole(seed, what, 0, MOST_SEED)


def numbers(
    value: Any, task: str, shape: tuple[int, ...] | None = None, *, whose: str = "", note: str = ""
) -> np.ndarray:
    """Return an array of numbers; tensors are allowed, also such as require a gradient or lie on a GPU.

    Args:
        value: an array, a tensor, a number, or a nested sequence of these.
        task: the task's name, for the error.
        shape: what it must have, if anything.
        whose: `` for agent_2`` or the like, for the error.
        note: what else the error says of what is allowed.

    Raises:
        ActionError: something else, such as text, complex numbers, rows of different lengths or None; or
            another shape.
    """
    of = "" if shape is None else f" of shape {shape}"
    allowed = f"{task}: numbers{of} are allowed{whose}{note}, got"
    try:
        array = value if type(value) is np.ndarray else np.asarray(_plain(value))
    except (ValueError, TypeError, RuntimeError) as error:
        raise ActionError(f"{allowed} {abbreviate(value)}: {error}") from error
    if array.dtype.kind not in "fiub" or (shape is not None and array.shape != shape):
        raise ActionError(f"{allowed} {array.dtype} of shape {array.shape}")
    return array


def _plain(value: Any) -> Any:
    """Tensors as arrays, within lists too."""
    if hasattr(value, "detach"):
        if value.is_complex():
            raise TypeError("a complex tensor")
        return value.detach().cpu().double().numpy()
    if isinstance(value, (list, tuple)):
        return [_plain(one) for one in value]
    return value
