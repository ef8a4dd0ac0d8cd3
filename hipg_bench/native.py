"""Plain functions of records and arrays, compiled together: for the processor, or left as Python.

Rules refer to each other by name and to a family's parts as ``rules.<name>``. `link` puts the family in, then
compiles everything that an entry calls. Nothing is reordered (no fast-math), so what a world gets depends
neither on the other worlds nor on the number of threads. Left as Python, the same functions are the oracle of
the tests, with bounds checked.

Machine code must know how a record is laid out, but not how many agents there are: it reads offsets and sizes
from an address table (`Memory`), so that it is compiled once for a family and kept on disk.
"""

from __future__ import annotations

import dataclasses
import dis
import functools
import hashlib
import importlib
import inspect
import os
import pickle
import sys
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from types import FunctionType, ModuleType, SimpleNamespace
from typing import Any, SupportsIndex

import numpy as np
from jaxtyping import Int

from hipg_bench import records
from hipg_bench.records import Field

Compiler = Callable[[FunctionType, bool], Any]
"""Takes a plain function, and whether it is called from outside."""


class Memory:
    """Where the records of a batch lie: an address table for machine code, NumPy's records for Python.

    Attributes:
        table: (K,) addresses, strides, offsets and sizes.
        kinds: record name to its entries.
        records: record name to the array that holds records of this kind.
    """

    def __init__(
        self,
        kinds: Mapping[str, tuple[Field, ...]],
        types: Mapping[str, np.dtype[np.void]],
        compiler: Compiler | None,
    ) -> None:
        self._plain = compiler is None
        self.kinds = dict(kinds)
        self.records: dict[str, np.recarray[Any, Any]] = {}
        self._types = types
        self._start: dict[str, int] = {}
        numbers: list[int] = []
        for name in kinds:
            self._start[name] = len(numbers)
            numbers += [0, 0]  # the address of the first record, and bytes from one to the next
            for shape, _, offset in records.places(types[name]).values():
                numbers += [offset, *shape]
        self.table: Int[np.ndarray, "K"] = np.array(numbers, np.int64)

    def bind(self, name: str, array: np.ndarray) -> None:
        """Let a name mean the records in ``array`` (bytes or numbers), which the caller keeps alive."""
        self.table[self._start[name]] = array.__array_interface__["data"][0]
        self.table[self._start[name] + 1] = self._types[name].itemsize
        if self._plain:
            self.records[name] = array.reshape(-1).view(self._types[name]).view(np.recarray)

    def places(self, names: Sequence[str]) -> Int[np.ndarray, "n"]:
        """Where in the table the addresses of these records are."""
        for name in names:
            self.table[self._start[name] + 1] = self._types[name].itemsize
        return np.array([self._start[name] for name in names])


def link(
    entry: Callable[..., Any], memory: Memory, rules: Mapping[str, Any], *, compiler: Compiler | None
) -> Callable[..., Any]:
    """Compile a function with every rule that it calls; what was compiled before is returned again.

    Args:
        entry: called from outside, with what `argument` gives first.
        memory: says which records there are. ``<name>_at(memory, k)`` in a rule is record k of that name.
        rules: the family: what stands for ``rules.<name>``.
        compiler: `for_processor`, or None to leave all as Python.
    """
    # of a record only what machine code must know: not how long its axes are
    kinds = tuple(
        (name, tuple(dataclasses.replace(entry, axes=("",) * len(entry.axes)) for entry in entries))
        for name, entries in memory.kinds.items()
    )
    return _link(_plain(entry), kinds, tuple(sorted(rules.items())), compiler)


@functools.cache
def _link(
    entry: FunctionType,
    kinds: tuple[tuple[str, tuple[Field, ...]], ...],
    rules: tuple[tuple[str, Any], ...],
    compiler: Compiler | None,
) -> Callable[..., Any]:
    bound: dict[str, Any] = {"rules": SimpleNamespace(**dict(rules))}
    start = 0
    for name, entries in kinds:
        bound[f"{name}_at"] = _plain_at(name) if compiler is None else _native_at(name, entries, start)
        start += _words(entries)
    done: dict[FunctionType, Any] = {}
    mark = _digest(entry, bound, kinds)

    def linked(function: FunctionType) -> Any:
        if function not in done:
            scope: dict[str, Any] = {"__builtins__": __builtins__, "__name__": function.__module__}
            parts: dict[str, dict[str, Any]] = {}
            for name, part, value in _uses(function, bound):
                value = linked(_plain(value)) if _is_rule(value) else value
                if part is None:
                    scope[name] = value
                else:
                    parts.setdefault(name, {})[part] = value
            for name, named in parts.items():
                scope[name] = _module(name, named)
            plain = FunctionType(function.__code__, scope, function.__name__, function.__defaults__)
            # a name says what machine code was made of: on disk, and where that of several families is loaded
            plain.__qualname__ = f"{function.__name__}_{mark}"
            plain.__module__ = function.__module__
            done[function] = compiler(plain, function is entry) if compiler else plain
        return done[function]

    return linked(entry)


def for_processor(function: FunctionType, outermost: bool) -> Any:
    """Machine code that runs without the interpreter's lock; that of the outermost is kept on disk."""
    numba = _numba()
    if not outermost:
        linking = importlib.import_module("hipg_bench.native_linking")
        return numba.njit(
            function, **_OPTIONS, no_cpython_wrapper=True, pipeline_class=linking.LinkedCompiler
        )

    def machine_code(*, kept: bool) -> Any:
        compiled = numba.njit(function, **_OPTIONS, nogil=True, cache=kept)
        compiled.compile(_SIGNATURE)  # now, so that all that is wrong with what is kept shows here
        return compiled

    notice = threading.Timer(_PATIENCE, print, [_COMPILING], {"file": sys.stderr, "flush": True})
    notice.daemon = True
    notice.start()
    try:
        return machine_code(kept=True)
    except _NOT_KEPT:
        return machine_code(kept=_forget(numba, function))
    finally:
        notice.cancel()


_OPTIONS = {"error_model": "numpy", "_nrt": False, "no_cfunc_wrapper": True}
"""Division by zero gives infinity, and nothing is allocated."""
_PATIENCE = 2.0
"""Seconds after which a user is told what is waited for: machine code that was kept is read sooner."""
_COMPILING = "hipg-bench: compiling the rules of this family for this machine, once (about 10 s)"
_SIGNATURE = "int64(int64[::1], int64, int64, int64, int64)"
"""Of functions called from outside: the address table, then whole numbers."""
_NOT_KEPT = (
    EOFError, OSError, RuntimeError, ValueError, TypeError, AttributeError, ImportError, KeyError, IndexError,
    pickle.UnpicklingError,
)  # fmt: skip
"""What reading damaged machine code raises, or writing it where there is no room or no place."""


def _forget(numba: Any, function: FunctionType) -> bool:
    """Empty what is kept of a function; False where nothing can be kept."""
    try:
        numba.njit(function, cache=True)._cache.flush()
    except (OSError, RuntimeError):
        return False
    return True


def compiles() -> bool:
    """Whether Numba makes machine code here: its users can turn that off, and all is Python then."""
    return not _numba().config.DISABLE_JIT


def _numba() -> Any:
    # Intel's vector functions round differently from libm's, and only some machines have them
    os.environ["NUMBA_DISABLE_INTEL_SVML"] = "1"
    return importlib.import_module("numba")


def _plain(function: Any) -> FunctionType:
    # in the tests, shapes are checked around it
    return inspect.unwrap(function)


def _uses(function: FunctionType, bound: Mapping[str, Any]) -> Iterator[tuple[str, str | None, Any]]:
    """Global names that a function reads, and which parts of our modules among them."""
    scope = {**function.__globals__, **bound}
    steps = list(dis.get_instructions(function))
    for step, after in zip(steps, [*steps[1:], None], strict=True):
        if step.opname == "LOAD_GLOBAL" and step.argval in scope:
            value = scope[step.argval]
            if step.argval == "rules" or (isinstance(value, ModuleType) and _ours(value.__name__)):
                if after is None:
                    raise TypeError(f"{function.__qualname__}: {step.argval} cannot be used by itself")
                yield step.argval, after.argval, getattr(value, after.argval)
            else:
                yield step.argval, None, value


def _is_rule(value: Any) -> bool:
    """Plain functions that are not a library's."""
    return isinstance(value, FunctionType) and not hasattr(value, "_hipg_record")


def _ours(module: str) -> bool:
    """Modules of rules: all but the two libraries that rules may use."""
    return module.partition(".")[0] not in ("math", "numpy")


def _module(name: str, parts: Mapping[str, Any]) -> ModuleType:
    module = ModuleType(name)
    vars(module).update(parts)
    return module


def _digest(entry: FunctionType, bound: Mapping[str, Any], kinds: Any) -> str:
    """Of the code of a function and of all that it calls, of the constants they name, and of the records."""
    sha, seen, todo = hashlib.sha256(repr(kinds).encode()), set[FunctionType](), [entry]
    while todo:
        function = todo.pop()
        if function in seen:
            continue
        seen.add(function)
        code = function.__code__
        sha.update(code.co_code + repr((code.co_consts, code.co_names, code.co_varnames)).encode())
        for name, part, value in _uses(function, bound):
            if _is_rule(value):
                todo.append(_plain(value))
            elif not isinstance(value, ModuleType) and not callable(value):
                sha.update(f"{name}.{part}={value!r}".encode())
    return sha.hexdigest()[:12]


def _plain_at(name: str) -> Any:
    def at(memory: Memory, k: SupportsIndex) -> Any:
        return memory.records[name][k]

    at._hipg_record = True  # pyright: ignore[reportFunctionMemberAccess]
    return at


def _native_at(name: str, entries: tuple[Field, ...], start: int) -> Any:
    from hipg_bench import native_records

    return native_records.accessor(name, entries, start)


def _words(entries: tuple[Field, ...]) -> int:
    """Numbers of the table about one kind of record: address, stride, and of each entry offset and axes."""
    return 2 + sum(1 + len(entry.axes) for entry in entries)


def argument(memory: Memory, compiler: Compiler | None) -> Any:
    """What a linked function takes as its ``memory``."""
    return memory if compiler is None else memory.table
