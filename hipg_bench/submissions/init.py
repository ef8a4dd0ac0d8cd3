"""`submit init`: a folder that `check` accepts once it is filled in and has weights."""

from __future__ import annotations

import json
import re
from pathlib import Path

import jinja2

from hipg_bench import registry
from hipg_bench.errors import BundleError
from hipg_bench.evaluation.seeds import SUITE
from hipg_bench.paths import write_text
from hipg_bench.submissions.paperwork import SUITE_TAG, TODO

_TEMPLATES = Path(__file__).parent / "templates"
_NAME = re.compile(r"[a-z0-9][a-z0-9_]{0,63}")


def _toml(text: str) -> str:
    """A TOML string: JSON's, but for characters beyond the basic plane, which stand as they are, and DEL."""
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")


def init(folder: Path, tier: int, *, authors: str = "", license: str = "", summary: str = "") -> list[Path]:
    """Write the templates of a tier into a new folder.

    Args:
        folder: its name is the agent's.
        tier: 0 for declared networks, 1 for ONNX graphs, 2 for Python.
        authors: for the card; what is not given is left to be filled in.
        license: the same.
        summary: the same.

    Returns:
        The files.

    Raises:
        BundleError: a name or tier that is not allowed, or the folder is there already.
    """
    name = folder.name
    if not _NAME.fullmatch(name):
        near = re.sub(r"[^a-z0-9]+", "_", name.lower()).strip("_")
        raise BundleError(
            f"name {name!r}: lower case letters, digits and _ are allowed; did you mean {near!r}?"
        )
    if tier not in (0, 1, 2):
        raise BundleError(f"tier {tier}: 0 (declared networks), 1 (ONNX) and 2 (Python) are allowed")
    if folder.exists():
        raise BundleError(f"{folder} is there already")
    values = {
        "name": name, "tier": tier, "suite": SUITE, "tasks": registry.tagged(SUITE_TAG),
        "authors": authors or TODO, "license": license or TODO, "summary": summary or f"{TODO}: one sentence",
    }  # fmt: skip
    engine = jinja2.Environment(loader=jinja2.FileSystemLoader(_TEMPLATES), undefined=jinja2.StrictUndefined)
    engine.filters["toml"] = _toml
    names = ["agent.toml", "README.md", *(["agent.py"] if tier == 2 else [])]
    for file in names:
        write_text(folder / file, engine.get_template(f"{file}.j2").render(values) + "\n")
    return [folder / file for file in names]
