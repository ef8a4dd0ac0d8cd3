"""The command line, and the only place that prints.

Modules of this package import nothing heavy at their top, so that ``--help`` answers at once and
``MUJOCO_GL`` can still be chosen.
"""

from __future__ import annotations

import sys

import typer

from hipg_bench.cli import (
    agents,
    audit,
    bench,
    calibrate,
    collect,
    compare,
    doctor,
    evaluate,
    export,
    figures,
    leaderboard,
    media,
    submit,
    suite,
    tasks,
    train,
)
from hipg_bench.errors import HipgError

app = typer.Typer(
    help="Teams that lose members: 3D tasks, trained teams, scores and films.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_show_locals=False,
)
app.command()(evaluate.evaluate)
app.command()(compare.compare)
app.command()(export.export)
app.command()(train.train)
app.command()(collect.collect)
app.command()(figures.figures)
app.command()(media.video)
app.command()(media.view)
app.add_typer(tasks.app, name="tasks")
app.add_typer(agents.app, name="agents")
app.add_typer(submit.app, name="submit")
app.add_typer(leaderboard.app, name="leaderboard")
app.add_typer(suite.app, name="suite")
app.command()(calibrate.calibrate)
app.command()(audit.audit)
app.command()(bench.bench)
app.command()(doctor.doctor)


def main() -> None:
    """Run the command line; mistakes of the user's are told in one line, with exit code 2."""
    try:
        app()
    except HipgError as error:
        sys.stderr.write(f"hipg-bench: {error}\n")
        sys.exit(2)
