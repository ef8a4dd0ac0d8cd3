"""JSON and TOML files that somebody else may have written or damaged."""

from __future__ import annotations

import codecs
import json
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

from hipg_bench.errors import SpecError


def read_json(path: Path) -> dict[str, Any]:
    """Read a file that holds a JSON object.

    Raises:
        SpecError: it holds something else.
        OSError: it cannot be read.
    """
    return _read(path, "JSON", lambda text: json.loads(text, parse_constant=_refuse))


def read_toml(path: Path) -> dict[str, Any]:
    """Read a TOML file.

    Raises:
        SpecError: it is none.
        OSError: it cannot be read.
    """
    return _read(path, "TOML", tomllib.loads)


def _read(path: Path, kind: str, parse: Callable[[str], Any]) -> dict[str, Any]:
    content = path.read_bytes()
    if content.startswith(codecs.BOM_UTF8):
        raise SpecError(f"{path}: begins with a byte-order mark: save it as UTF-8 without one")
    try:
        values = parse(content.decode("utf-8"))
    except (ValueError, RecursionError) as error:
        raise SpecError(f"{path}: not {kind}: {error}") from error
    if not isinstance(values, dict):
        raise SpecError(f"{path}: a {kind} object is expected, got a {type(values).__name__}")
    return cast(dict[str, Any], values)


def _refuse(constant: str) -> Any:
    raise ValueError(f"{constant} is not allowed")
