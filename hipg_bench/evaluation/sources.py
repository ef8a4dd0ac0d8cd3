"""Which files of the package decide how an episode goes: all that the code which plays one imports."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

_PACKAGE = Path(__file__).resolve().parents[1]
_ROOTS = ("evaluation/episodes.py", "evaluation/results.py")
"""What plays an episode and writes its row, and what turns rows into scores."""


def files() -> list[Path]:
    """Paths of the files, relative to the package, in order.

    Imports are followed wherever they stand, within functions too, but for those that only type checkers
    read.
    """
    found: set[Path] = set()
    waiting = [Path(root) for root in _ROOTS]
    while waiting:
        path = waiting.pop()
        if path not in found:
            found.add(path)
            waiting += _imported(path)
    return sorted(found)


def _imported(path: Path) -> Iterator[Path]:
    """The package's files that one of them imports; of a package within it, ``__init__.py``."""
    for name in _names(ast.parse((_PACKAGE / path).read_text(encoding="utf-8"))):
        package, *inner = name.split(".")
        if package == _PACKAGE.name:
            place = Path(*inner)
            for candidate in (place / "__init__.py", place.with_suffix(".py") if inner else place):
                if (_PACKAGE / candidate).is_file():
                    yield candidate


def _names(node: ast.AST) -> Iterator[str]:
    """Modules that are imported, and what is imported from them, which may be modules too."""
    if isinstance(node, ast.Import):
        yield from (alias.name for alias in node.names)
    elif isinstance(node, ast.ImportFrom):
        if node.level or node.module is None:
            raise ValueError(f"line {node.lineno}: relative imports are not followed")
        yield node.module
        yield from (f"{node.module}.{alias.name}" for alias in node.names)
    for child in ast.iter_child_nodes(node):
        if not (isinstance(node, ast.If) and _for_types_only(node.test) and child in node.body):
            yield from _names(child)


def _for_types_only(test: ast.expr) -> bool:
    return ast.unparse(test) in ("TYPE_CHECKING", "typing.TYPE_CHECKING")
