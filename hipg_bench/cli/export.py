"""``hipg-bench export``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from hipg_bench.cli import console, outputs


def export(
    folders: Annotated[
        list[Path], typer.Argument(help="Folders written by `evaluate`, one per agent and split.")
    ],
    out: Annotated[Path, typer.Option(help="Output file.")] = Path("marl_eval.json"),
) -> None:
    """Write evaluations of several agents in the JSON format of marl-eval."""
    import json

    from hipg_bench.evaluation.export import marl_eval
    from hipg_bench.paths import write_text

    outputs.check_free(out, outputs.MARL_EVAL)
    write_text(out, json.dumps(marl_eval(folders), allow_nan=False) + "\n")
    console.say(str(out))
