"""The command line, and the only place that prints.

Modules of this package import nothing heavy at their top, so that ``--help`` answers at once and
``MUJOCO_GL`` can still be chosen.
"""

from __future__ import annotations

import errno
import io
import os
import signal
import sys
from types import FrameType
from typing import Annotated, Any, NoReturn

import typer
import typer.core

from hipg_bench.cli import (
    agents,
    audit,
    bench,
    calibrate,
    collect,
    compare,
    console,
    doctor,
    evaluate,
    export,
    figures,
    hub,
    leaderboard,
    media,
    reproduce,
    rollout,
    settings,
    submit,
    suite,
    tasks,
    train,
)
from hipg_bench.errors import HipgError


class _Commands(typer.core.TyperGroup):
    """The commands; what the machine refuses them becomes an error that names the file."""

    def invoke(self, ctx: Any) -> Any:
        """Run a command.

        Raises:
            HipgError: a mistake of the user's, or of a file's or the machine's.
        """
        try:
            return super().invoke(ctx)
        except OSError as error:
            if error.errno == errno.EPIPE:
                raise
            place = f"{error.filename}: " if error.filename is not None else ""
            raise HipgError(f"{place}{error.strerror or error}") from error
        except MemoryError as error:
            raise HipgError("there is not enough memory") from error


app = typer.Typer(
    cls=_Commands,
    no_args_is_help=True,
    pretty_exceptions_show_locals=False,
)


def _print_version(wanted: bool) -> bool:
    if wanted:
        from hipg_bench import __version__

        console.say(f"hipg-bench {__version__}")
        raise typer.Exit
    return wanted


@app.callback()
def _program(
    version: Annotated[
        bool,
        typer.Option("--version", help="Print the version and exit.", callback=_print_version, is_eager=True),
    ] = False,
) -> None:
    """Benchmark for multi-agent teams that lose members: tasks, training, evaluation and videos."""


app.command()(evaluate.evaluate)
app.command()(compare.compare)
app.command()(export.export)
app.command()(train.train)
app.command()(reproduce.reproduce)
app.command()(settings.settings)
app.command()(collect.collect)
app.command()(figures.figures)
app.command()(media.video)
app.command()(media.view)
app.command()(rollout.rollout)
app.add_typer(tasks.app, name="tasks")
app.add_typer(agents.app, name="agents")
app.add_typer(submit.app, name="submit")
app.add_typer(hub.app, name="hub")
app.add_typer(leaderboard.app, name="leaderboard")
app.add_typer(suite.app, name="suite")
app.command()(calibrate.calibrate)
app.command()(audit.audit)
app.command()(bench.bench)
app.command()(doctor.doctor)


def main() -> None:
    """Run the command line. Errors are one line and exit code 2; an interruption exits with 130."""
    _open_what_is_closed()
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")  # a terminal that knows no UTF-8
    for name in ("SIGTERM", "SIGHUP"):
        if hasattr(signal, name) and signal.getsignal(getattr(signal, name)) is signal.SIG_DFL:
            signal.signal(getattr(signal, name), _interrupt)
    _check_environment()
    try:
        app()
    except HipgError as error:
        _end(str(error))
    except SystemExit as ended:
        if ended.code == _INTERRUPTED:
            console.warn("hipg-bench: interrupted")
        raise


def _open_what_is_closed() -> None:
    """Where the shell closed a standard stream, let it lead nowhere: else a file of ours would become it."""
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest number that is free
    for name in ("stdin", "stdout", "stderr"):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "r+"))  # noqa: SIM115 (for as long as the program runs)


_INTERRUPTED = 130
"""Exit code after Ctrl-C, as shells have it."""


def _interrupt(number: int, frame: FrameType | None) -> None:
    """End as after Ctrl-C: children end, and temporary files go."""
    signal.signal(number, signal.SIG_IGN)
    raise KeyboardInterrupt


def _check_environment() -> None:
    """Refuse what keeps MuJoCo from being imported; ``doctor`` tells of it itself."""
    from hipg_bench.rendering import gl

    chosen = os.environ.get("MUJOCO_GL", "")
    if chosen.lower() not in gl.NAMES and sys.argv[1:2] != ["doctor"]:
        _end(f"MUJOCO_GL = {chosen!r} is refused: {', '.join(gl.BACKENDS)} or glfw is allowed, or unset it")


def _end(message: str) -> NoReturn:
    console.warn(f"hipg-bench: {message}")
    sys.exit(2)
