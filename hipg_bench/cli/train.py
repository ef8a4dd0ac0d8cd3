"""``hipg-bench train``."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from hipg_bench.cli import console
from hipg_bench.errors import SpecError, hint

if TYPE_CHECKING:
    from hipg_bench.learning.settings import AnySettings


def train(
    out: Annotated[Path, typer.Option(help="Folder of the run; an unfinished run in it goes on.")],
    task: Annotated[str | None, typer.Option(help="The task's name.")] = None,
    arm: Annotated[
        str, typer.Option(help="MAPPO by its credit: min_health, central, local; or maddpg, qmix.")
    ] = "min_health",
    preset: Annotated[
        str, typer.Option(help="Settings to start from: recommended or paper.")
    ] = "recommended",
    seed: Annotated[int, typer.Option(min=0, max=999, help="Fixes all chance of the run.")] = 0,
    steps: Annotated[
        int | None, typer.Option(min=1, help="Environment steps, by default the preset's.")
    ] = None,
    setting: Annotated[
        list[str] | None, typer.Option("--set", help="Another setting, as name=value; may be repeated.")
    ] = None,
    threads: Annotated[
        int, typer.Option(min=1, help="Of physics and of torch. One run per core is faster.")
    ] = 1,
    sweep: Annotated[
        Path | None, typer.Option(help="A file that lists many runs, instead of --task.")
    ] = None,
    workers: Annotated[
        int | None, typer.Option(min=1, help="Runs of a sweep at a time, by default one per core.")
    ] = None,
    status: Annotated[bool, typer.Option("--status", help="Only say how far a sweep is.")] = False,
) -> None:
    """Train a team, or the many of a sweep; what was killed goes on with the same command."""
    if (task is None) == (sweep is None) or (status and sweep is None):
        raise SpecError("train takes either --task or --sweep; --status belongs to the latter")
    from hipg_bench.processes import usable_cores

    if sweep is not None and status:
        _tell(sweep, out, workers or usable_cores())
        return
    if sweep is not None:
        _train_many(sweep, out, workers or usable_cores())
        return

    import torch

    from hipg_bench.learning.settings import PRESETS

    torch.set_num_threads(threads)
    if preset not in PRESETS:
        raise SpecError(f"no preset {preset!r}{hint(preset, PRESETS)}")
    changes: dict[str, Any] = {"arm": arm, "seed": seed, **_parsed(setting or [])}
    if steps is not None:
        changes["steps"] = steps
    settings = PRESETS[preset](task, **changes)
    options = [
        f"--task {task}",
        f"--arm {arm}",
        f"--preset {preset}",
        f"--seed {seed}",
        *(f"--set {pair}" for pair in setting or []),
    ]
    command = " ".join(["hipg-bench train", *options, f"--steps {settings.steps}", f"--out {out}"])
    _train_one(settings, out, command)


def _train_one(settings: AnySettings, out: Path, command: str) -> None:
    from hipg_bench.learning.run import train as run

    console.say(
        f"{settings.task}, arm {settings.arm}, seed {settings.seed}: "
        f"{settings.steps:,} environment steps into {out}"
    )
    with console.progress() as bars:
        bar = bars.add_task("training", total=settings.iterations)

        def report(iteration: int, log: dict[str, float]) -> None:
            bars.update(bar, completed=iteration, description=f"return {log.get('return', float('nan')):.4g}")

        run(settings, out, command=command, report=report)
    console.say(f"policy: {out / 'policy.safetensors'}, curve: {out / 'curve.csv'}")


def _train_many(sweep: Path, out: Path, workers: int) -> None:
    from hipg_bench.learning.sweep import Run, load, work_off

    runs = load(sweep, out)
    left = sum(not run.finished for run in runs)
    console.say(f"{sweep.name}: {left} of {len(runs)} runs to do, {workers} at a time, into {out}")
    with console.progress() as bars:
        bar = bars.add_task("training", total=sum(run.settings.steps for run in runs))

        def report(runs: list[Run]) -> None:
            ended = sum(run.finished for run in runs)
            steps = sum(min(run.done, run.settings.steps) for run in runs)
            bars.update(bar, completed=steps, description=f"{ended}/{len(runs)} runs")

        work_off(runs, workers, report)
    console.say(f"{len(runs)} runs are finished in {out}")


def _tell(sweep: Path, out: Path, workers: int) -> None:
    import time

    from hipg_bench.learning.sweep import load, standings

    found = standings(load(sweep, out), time.time())
    rows = console.table("task", "arm", ">seed", "state", ">steps", ">minutes", ">left", title=sweep.name)
    for one in found:
        settings = one.run.settings
        rows.add_row(
            settings.task,
            one.run.arm,
            str(settings.seed),
            one.state,
            f"{one.steps:,} / {settings.steps:,}",
            console.number(one.seconds / 60, 0),
            console.number(None if one.left is None else one.left / 60, 0),
        )
    console.show(rows)
    known = [one.left for one in found if one.left is not None]
    hours = (
        "unknown before a run has begun"
        if len(known) < len(found)
        else f"{sum(known) / workers / 3600:.1f} h"
    )
    states = ", ".join(
        f"{sum(one.state == state for one in found)} {state}"
        for state in ("finished", "running", "stopped", "waiting")
    )
    console.say(f"{states}; time left with {workers} at a time: {hours}")


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
