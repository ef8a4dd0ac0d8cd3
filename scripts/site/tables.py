"""Markdown tables."""

from collections.abc import Iterable, Sequence


def table(columns: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """A Markdown table; a column whose title begins with ``>`` is aligned to the right."""
    lines = [
        [column.removeprefix(">") for column in columns],
        ["--:" if column.startswith(">") else "---" for column in columns],
        *([str(cell).replace("|", "\\|") for cell in row] for row in rows),
    ]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines) + "\n"
