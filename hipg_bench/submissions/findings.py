"""What `check` tells: what is wrong or could be better, where, and what to do about it."""

from __future__ import annotations

import dataclasses
from typing import Literal

Severity = Literal["error", "advice", "fine"]


@dataclasses.dataclass(frozen=True)
class Finding:
    """One thing that was looked at.

    Attributes:
        severity: an ``error`` keeps the bundle from being packed; ``advice`` does not.
        where: file, field or task.
        what: what was found.
        remedy: what to do.
    """

    severity: Severity
    where: str
    what: str
    remedy: str = ""


def error(where: str, what: str, remedy: str = "") -> Finding:
    """Something that must be fixed."""
    return Finding("error", where, what, remedy)


def advice(where: str, what: str, remedy: str = "") -> Finding:
    """Something that could be better."""
    return Finding("advice", where, what, remedy)


def fine(where: str, what: str) -> Finding:
    """Something that is as it should be."""
    return Finding("fine", where, what)
