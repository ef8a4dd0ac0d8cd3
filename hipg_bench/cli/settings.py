"""``hipg-bench settings``."""

from __future__ import annotations

from typing import Annotated

import typer

from hipg_bench.cli import console
from hipg_bench.cli.options import PluginOption, TaskArgument, task_of
from hipg_bench.errors import SpecError, hint


def settings(
    task: TaskArgument,
    algorithm: Annotated[str, typer.Argument(help="An algorithm, as for `train --algorithm`.")],
    preset: Annotated[str, typer.Option(help="Preset of settings: recommended or paper.")] = "recommended",
    plugin: PluginOption = None,
) -> None:
    """Print all training settings of a task and an algorithm as a TOML file for `train --settings`."""
    from hipg_bench.learning.settings import PRESETS, to_toml

    if preset not in PRESETS:
        raise SpecError(f"no preset {preset!r}{hint(preset, PRESETS)}")
    name = task_of(task).task
    console.say(f"# {preset} settings of {algorithm} on {name}; train --set NAME=VALUE changes single ones")
    console.say(to_toml(PRESETS[preset](name, algorithm=algorithm)).rstrip())
