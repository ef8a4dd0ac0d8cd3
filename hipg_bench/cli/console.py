"""What all commands share: where to print, and how to show that something takes a while."""

from __future__ import annotations

import contextlib
import json
import sys
import threading
import unicodedata
from collections.abc import Generator
from types import TracebackType
from typing import Any

from rich.console import Console, RenderableType
from rich.padding import Padding
from rich.progress import BarColumn, Progress, Task, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table
from rich.text import Text

out = Console(highlight=False)
"""Results."""
err = Console(stderr=True, highlight=False)
"""Everything else."""


PLAIN_SECONDS = 30.0
"""Time between two lines of progress where the error stream is no terminal, s."""


def progress() -> Progress:
    """A progress display with the time left; where the error stream is no terminal, a line every 30 s."""
    kind = Progress if sys.stderr.isatty() else _PlainProgress
    return kind(
        TextColumn("{task.description:<18}", markup=False),
        BarColumn(bar_width=None),
        TextColumn("{task.percentage:>3.0f} %"),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
        console=err,
        transient=True,
        disable=not sys.stderr.isatty(),
    )


@contextlib.contextmanager
def paused(bars: Progress) -> Generator[None]:
    """Take a progress display away while results are printed."""
    bars.stop()
    yield
    bars.start()


class _PlainProgress(Progress):
    """Progress as plain lines, so that the log of a job is never silent for minutes."""

    def __enter__(self) -> _PlainProgress:
        """Begin to print lines."""
        self._stopped = threading.Event()
        self._printer = threading.Thread(target=self._print_lines, daemon=True)
        self._printer.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Print no more lines."""
        self._stopped.set()
        self._printer.join()

    def start(self) -> None:
        """Show nothing that is drawn over."""

    def stop(self) -> None:
        """See `start`."""

    def _print_lines(self) -> None:
        while not self._stopped.wait(PLAIN_SECONDS):
            running = [task for task in self.tasks if task.completed and not task.finished]
            if running:
                warn("; ".join(_progress_line(task) for task in running))


def _progress_line(task: Task) -> str:
    """How far a task is, such as ``films: 35 % after 90 s, about 160 s left``."""
    share = "" if task.total is None else f"{task.percentage:.0f} % "
    left = task.time_remaining
    return f"{task.description}: {share}after {task.elapsed or 0:.0f} s" + (
        "" if left is None else f", about {left:.0f} s left"
    )


def table(*columns: str, title: str | None = None) -> Table:
    """A plain table; ``>`` before a column's name aligns it to the right, and only the last one wraps."""
    made = _Table(
        title=title, title_justify="left", box=None, pad_edge=False, header_style="bold", padding=(0, 2, 0, 0)
    )
    for k, column in enumerate(columns, start=1):
        right = column.startswith(">")
        made.add_column(column.lstrip(">"), justify="right" if right else "left", no_wrap=k < len(columns))
    return made


class _Table(Table):
    """A table whose cells are plain text: names and reasons come from strangers."""

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self.texts: list[tuple[str, ...]] = []

    def add_row(self, *cells: RenderableType | None, **options: Any) -> None:
        """Add a row; see rich's own."""
        self.texts.append(tuple(str(cell or "") for cell in cells))
        plain = (Text(printable(cell)) if isinstance(cell, str) else cell for cell in cells)
        super().add_row(*plain, **options)


def printable(text: str) -> str:
    """The text without what steers a terminal or cannot be encoded: control characters, surrogates.

    Line ends and tabs stay.
    """
    return "".join(
        character if character in "\n\t" or unicodedata.category(character) not in _UNPRINTABLE else "\ufffd"
        for character in text
    )


_UNPRINTABLE = ("Cc", "Cf", "Cs", "Co", "Zl", "Zp")
"""Categories of Unicode."""


def show(rows: Table) -> None:
    """Print a table; wide enough for a pipe or file that has no width."""
    if not out.file.isatty():
        out.width = max(out.width, 240)
    if isinstance(rows, _Table) and not _fits(rows):
        _print_records(rows)
    else:
        out.print(rows)


_NARROWEST = 24
"""Characters that the last column of a table needs to be read."""


def _fits(rows: _Table) -> bool:
    """Whether all columns but the last are narrow enough to leave room for it."""
    headers = [str(column.header) for column in rows.columns]
    widths = [max(len(line) for line in column) for column in zip(headers, *rows.texts, strict=False)]
    *others, last = widths
    return sum(others) + 2 * len(others) + min(last, _NARROWEST) <= out.width


def _print_records(rows: _Table) -> None:
    """Print rows one below the other, for a narrow terminal."""
    if rows.title:
        say(f"{rows.title}".lstrip("\n"))
    headers = [str(column.header).strip() for column in rows.columns]
    for first, *cells in rows.texts:
        out.print(Text(printable(first), style="bold"))
        told = [
            f"{header}: {cell}" if header else cell
            for header, cell in zip(headers[1:], cells, strict=False)
            if cell.strip() not in ("", "-")
        ]
        out.print(Padding(Text(printable("; ".join(told))), (0, 0, 0, 2)))


def say(text: str) -> None:
    """Print a line of the results, unbroken."""
    out.print(Text(printable(text)), soft_wrap=True)


def warn(text: str) -> None:
    """Print a line on the error stream, unbroken."""
    err.print(Text(printable(text)), soft_wrap=True)


def show_json(value: Any) -> None:
    """Print JSON for a script."""
    sys.stdout.write(json.dumps(value, indent=2) + "\n")


def number(value: float | None, digits: int = 2) -> str:
    """A number, or a dash where it is not defined."""
    return "-" if value is None else f"{value:.{digits}f}"


def interval(ends: list[float] | tuple[float, float] | None, digits: int = 2) -> str:
    """A 95 % interval in brackets."""
    return "" if ends is None else f"[{ends[0]:.{digits}f}, {ends[1]:.{digits}f}]"
