"""The site's page of the command line, from the same declarations as ``--help``."""

from collections.abc import Iterator
from typing import Any

from tables import table
from typer.main import get_command

from hipg_bench.cli import app


def page() -> str:
    """All commands with their arguments and options, as Markdown."""
    root = get_command(app)
    start = (
        "# Command line\n\nEvery command explains itself with `--help`, by these texts. Commands exit with "
        "0 on success, 1 where a check failed, and 2 where what they were given is refused.\n"
    )
    return "\n".join([start, *_sections(root, "hipg-bench", 2)])


def _sections(command: Any, name: str, level: int) -> Iterator[str]:
    for each, part in sorted(getattr(command, "commands", {}).items()):
        yield f"{'#' * level} {name} {each}\n\n{' '.join((part.help or '').split())}\n"
        rows = [
            row
            for parameter in part.params
            if not getattr(parameter, "hidden", False) and (row := _row(parameter)) is not None
        ]
        if rows and not getattr(part, "commands", None):
            yield table(("", "", "default"), rows)
        yield from _sections(part, f"{name} {each}", level + 1)


def _row(parameter: Any) -> tuple[str, str, str] | None:
    if parameter.param_type_name == "argument":
        return f"`{str(parameter.name).upper()}`", parameter.help or "", _default(parameter)
    if parameter.name == "help":
        return None
    return f"`{', '.join(parameter.opts)}`", parameter.help or "", _default(parameter)


def _default(parameter: Any) -> str:
    value = parameter.default
    if parameter.required:
        return "required"
    return "" if value is None or value is False or callable(value) or value == () else f"`{value}`"
