"""How Numba compiles functions that only other compiled functions call.

Numba makes every function ready to run by itself: it optimises it together with all that it calls, and
translates it. For some fifty rules that call each other this is half of the time that compiling takes. Here
they stay LLVM's intermediate code; the function that is called from outside is linked with all of them, then
optimised and translated once.
"""

from __future__ import annotations

from typing import Any

from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler


class _NoEnvironment:
    """Where Numba would note what a function needs of the interpreter: rules need nothing of it."""

    @staticmethod
    def set_env(name: str, environment: Any) -> None:
        """Note nothing."""


class _LinkedLibrary(JITCodeLibrary):
    """Intermediate code of one function, to be linked into those that call it."""

    @property
    def codegen(self) -> Any:
        """Numba's, as far as what comes after linking needs it."""
        return _NoEnvironment

    def get_pointer_to_function(self, name: str) -> int:
        """The function cannot be called from outside."""
        self._ensure_finalized()
        return 0

    def _optimize_final_module(self) -> None:
        pass

    def _finalize_final_module(self) -> None:
        self._finalize_dynamic_globals()
        self._verify_declare_only_symbols()
        self._finalized = True


class LinkedCompiler(Compiler):
    """Numba's compiler, but for what it makes of a function in the end."""

    def __init__(self, typing: Any, target: Any, library: Any, *rest: Any) -> None:
        super().__init__(typing, target, _LinkedLibrary(target.codegen(), "rules"), *rest)
