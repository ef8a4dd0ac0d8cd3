"""Errors that teach: what was got, what is allowed, and what was probably meant."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


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


class RenderError(HipgError, RuntimeError):
    """A frame or film that could not be made."""


class ResumeError(HipgError, RuntimeError):
    """An output folder that belongs to another run."""


def hint(name: str, allowed: Iterable[str]) -> str:
    """Return ``"; did you mean 'x'?"`` for the nearest allowed name, else what is allowed."""
    names = sorted(allowed)
    near = difflib.get_close_matches(name, names, n=1, cutoff=0.5)
    return f"; did you mean {near[0]!r}?" if near else f"; there are: {', '.join(names)}"
