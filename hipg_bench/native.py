"""Plain loops over worlds, compiled to machine code on first use; work on worlds shared out over threads.

NumPy passes over memory once per operation; a loop that does all it must for one world and then goes on
to the next is several times faster, and reads as the rule does. Nothing is reordered (no fast-math), so
what a world gets depends neither on the other worlds nor on the number of threads.
"""

from __future__ import annotations

import contextlib
import functools
import inspect
import os
import pickle
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from types import FunctionType
from typing import Any, Generic, ParamSpec, TypeVar, cast

from hipg_bench.processes import usable_cores

_WORTH = 128
"""Worlds per thread from which on another thread pays."""

P = ParamSpec("P")
R = TypeVar("R")


class compiled(Generic[P, R]):  # noqa: N801 (a decorator)
    """Compile a function of numbers and arrays when it is first called; keep the machine code on disk.

    It may call other compiled functions of its own file: what is kept is made anew when that file changes.
    """

    def __init__(self, function: Callable[P, R]) -> None:
        # in the tests, shapes are checked around it
        self._function = cast(FunctionType, inspect.unwrap(function))
        functools.update_wrapper(self, function)

    def __call__(self, *args: P.args, **kwargs: P.kwargs) -> R:
        """Run the machine code."""
        try:
            return self.native(*args, **kwargs)
        except _NO_CACHE:  # what was kept is damaged, or the disk is full: compile without it
            self._forget()
            self.native = self._compiled(cache=False)
            return self.native(*args, **kwargs)

    @functools.cached_property
    def native(self) -> Callable[P, R]:
        """The machine code, which runs without the interpreter's lock."""
        try:
            return self._compiled(cache=True)
        except RuntimeError:  # there is nowhere to keep it
            return self._compiled(cache=False)

    def _compiled(self, *, cache: bool) -> Callable[P, R]:
        # half a second for which only those who step worlds need to wait
        import numba

        plain = self._function
        natives = {
            name: called.native if cache else called._compiled(cache=False)
            for name, called in self._called().items()
        }
        linked = FunctionType(plain.__code__, plain.__globals__ | natives, plain.__name__)
        linked.__qualname__ = plain.__qualname__
        compiler: Any = numba.njit
        return compiler(linked, nogil=True, cache=cache)

    def _called(self) -> dict[str, compiled[..., Any]]:
        """The compiled functions that this one calls, by name."""
        scope = self._function.__globals__
        names = [name for name in self._function.__code__.co_names if name in scope]
        return {name: scope[name] for name in names if isinstance(scope[name], compiled)}

    def _forget(self) -> None:
        """Let Numba forget what it kept of this function and those it calls, so that it is kept anew."""
        for called in self._called().values():
            called._forget()
        native: Any = self.native
        with contextlib.suppress(OSError, AttributeError):
            native._cache.flush()


_NO_CACHE = (EOFError, OSError, pickle.UnpicklingError, AttributeError, ImportError, KeyError, IndexError)
"""What reading damaged machine code, or writing it to a full disk, raises; our loops raise nothing."""


def on_threads(work: Callable[[slice], None], worlds: int, threads: int) -> None:
    """Do some work on all worlds, each thread on a part of them."""
    parts = max(1, min(threads, worlds // _WORTH))
    first, *rest = (slice(worlds * k // parts, worlds * (k + 1) // parts) for k in range(parts))
    others = [_pool().submit(work, part) for part in rest]
    work(first)
    for other in others:
        other.result()


@functools.cache
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(usable_cores(), thread_name_prefix="hipg-worlds")


if hasattr(os, "register_at_fork"):
    # a forked child has none of its parent's threads
    os.register_at_fork(after_in_child=_pool.cache_clear)
