"""Errors that teach: what was got, what is allowed, and what was probably meant."""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from typing import Literal

FailureStatus = Literal["crash", "timeout", "not_finite", "wrong_shape"]
"""How an agent may fail: its process ended, it was too slow, or its answer is no action."""


class HipgError(Exception):
    """Any error this package raises on purpose."""


class SpecError(HipgError, ValueError):
    """A task specification or an override holds something that is not allowed."""


class ActionError(HipgError, ValueError):
    """An action of the wrong shape, or with a value that is not a number."""


class UnknownNameError(HipgError, KeyError):
    """A task, agent or field that does not exist."""

    def __str__(self) -> str:
        return str(self.args[0])


class BundleError(HipgError, ValueError):
    """An agent bundle that cannot be read, or does not fit the task."""


class AgentFailure(HipgError, RuntimeError):  # noqa: N818  a verdict, not a defect of ours
    """A submitted agent did not answer as it must; its episode goes on without it and counts.

    Attributes:
        status: what went wrong, as it stands in the episode's row.
    """

    def __init__(self, status: FailureStatus, message: str) -> None:
        super().__init__(message)
        self.status: FailureStatus = status


class BoardError(HipgError, RuntimeError):
    """A leaderboard that refuses a change: a name that is taken, a salt that is not the right one."""


class HostFailure(HipgError, RuntimeError):  # noqa: N818  as above
    """This machine, not the agent, is at fault: its process could not be started, or the disk is full."""


class SandboxError(HipgError, RuntimeError):
    """No way to run foreign code safely works on this machine."""


class RenderError(HipgError, RuntimeError):
    """A frame or film that could not be made."""


class ResumeError(HipgError, RuntimeError):
    """An output folder that belongs to another run."""


def abbreviate(value: object) -> str:
    """A value for an error message: short, whatever it is."""
    try:
        text = repr(value)
    except ValueError:  # Python prints no whole number of thousands of digits
        return f"a {type(value).__name__} of thousands of digits"
    return text if len(text) <= _LONGEST_VALUE else f"{text[:_LONGEST_VALUE]}..."


_LONGEST_VALUE = 120


def hint(name: str, allowed: Iterable[str]) -> str:
    """Return ``"; did you mean 'x'?"`` for the nearest allowed name, else what is allowed.

    A name also counts as near if only its beginning is: ``mapo`` is nearer to ``mappo_central`` than to
    ``maddpg``.Names that are equally near are all told, but for
    those that only go on where another one of them ends.
    """
    names = sorted(allowed)
    nearness = {known: _nearness(name, known) for known in names}
    best = max(nearness.values(), default=0.0)
    if best < _NEAR:
        return f"; there are: {', '.join(names)}"
    ties = [known for known, value in nearness.items() if value == best]
    near = [repr(known) for known in ties if not any(known != one and known.startswith(one) for one in ties)]
    listed = near[0] if len(near) == 1 else f"{', '.join(near[:-1])} or {near[-1]}"
    return f"; did you mean {listed}?"


_NEAR = 0.5
"""Share of equal characters above which a name is worth telling."""


def _nearness(name: str, known: str) -> float:
    """Share of equal characters of two names, or, which counts less, of one and the other's beginning."""
    whole = difflib.SequenceMatcher(None, known, name).ratio()
    beginning = max(
        difflib.SequenceMatcher(None, known[: len(name) + more], name).ratio() for more in (-1, 0, 1)
    )
    return max(whole, 0.95 * beginning)
