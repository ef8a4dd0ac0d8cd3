"""``hipg-bench train``."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any

import typer

from hipg_bench.cli import console
from hipg_bench.errors import SpecError


def train(
    task: Annotated[str, typer.Option(help="The task's name.")],
    out: Annotated[Path, typer.Option(help="Folder of the run; an unfinished run in it goes on.")],
    arm: Annotated[str, typer.Option(help="How credit is assigned: min_health or central.")] = "min_health",
    seed: Annotated[int, typer.Option(min=0, max=999, help="Fixes all chance of the run.")] = 0,
    steps: Annotated[
        int | None, typer.Option(min=1, help="Environment steps, by default as recommended.")
    ] = None,
    setting: Annotated[
        list[str] | None, typer.Option("--set", help="Another setting, as name=value; may be repeated.")
    ] = None,
    threads: Annotated[
        int, typer.Option(min=1, help="Of physics and of torch. One run per core is faster.")
    ] = 1,
) -> None:
    """Train a MAPPO team; a killed run goes on from its last checkpoint with the same command."""
    import torch

    from hipg_bench.learning.run import train as run
    from hipg_bench.learning.settings import recommended

    torch.set_num_threads(threads)
    changes: dict[str, Any] = {"arm": arm, "seed": seed, **_parsed(setting or [])}
    if steps is not None:
        changes["steps"] = steps
    settings = recommended(task, **changes)
    options = [
        f"--task {task}",
        f"--arm {arm}",
        f"--seed {seed}",
        *(f"--set {pair}" for pair in setting or []),
    ]
    command = " ".join(["hipg-bench train", *options, f"--steps {settings.steps}", f"--out {out}"])
    console.say(
        f"[bold]{task}[/bold], arm {arm}, seed {seed}: {settings.steps:,} environment steps into {out}"
    )
    with console.progress() as bars:
        bar = bars.add_task("training", total=settings.iterations)

        def report(iteration: int, log: dict[str, float]) -> None:
            bars.update(bar, completed=iteration, description=f"return {log.get('return', float('nan')):.4g}")

        run(settings, out, command=command, report=report)
    console.say(f"policy: {out / 'policy.safetensors'}, curve: {out / 'curve.csv'}")


def _parsed(pairs: list[str]) -> dict[str, Any]:
    """``name=value`` options; a value that is not JSON is a string."""
    parsed: dict[str, Any] = {}
    for pair in pairs:
        name, equals, value = pair.partition("=")
        if not equals:
            raise SpecError(f"--set takes name=value, got {pair!r}")
        try:
            parsed[name] = json.loads(value)
        except json.JSONDecodeError:
            parsed[name] = value
    return parsed
