"""``hipg-bench bench``."""

from __future__ import annotations

import dataclasses
from typing import Annotated

import typer

from hipg_bench.cli import console


def bench(
    tasks: Annotated[
        str, typer.Option(help="Task names with commas between, or: standard, paper, all.")
    ] = "standard",
    num_envs: Annotated[str, typer.Option(help="Batch sizes with commas between.")] = "1,64,1024",
    threads: Annotated[str, typer.Option(help="Physics threads with commas between, 0 for all cores.")] = "0",
    seconds: Annotated[float, typer.Option(min=0.1, help="Per measurement.")] = 2.0,
    as_json: Annotated[bool, typer.Option("--json", help="For scripts.")] = False,
) -> None:
    """Measure step rates beside raw mujoco.batch on the same model."""
    from hipg_bench.cli.evaluate import suite_of
    from hipg_bench.evaluation.bench import measure

    wanted = [
        (spec, size, count)
        for spec in suite_of(tasks).specs
        for count in _numbers(threads, "--threads", 0)
        for size in _numbers(num_envs, "--num-envs", 1)
    ]
    with console.progress() as bars:
        rates = [
            measure(spec, size, threads=count, seconds=seconds)
            for spec, size, count in bars.track(wanted, description="bench")
        ]
    if as_json:
        console.show_json([dataclasses.asdict(rate) for rate in rates])
        return
    rows = console.table("task", ">threads", ">envs", ">env-steps/s", ">raw physics", ">share")
    for rate in rates:
        rows.add_row(
            rate.task, str(rate.threads or "all"), str(rate.num_envs), f"{rate.env:,.0f}", f"{rate.raw:,.0f}",
            f"{100 * rate.share:.0f} %",
        )  # fmt: skip
    console.show(rows)


def _numbers(text: str, option: str, least: int) -> list[int]:
    """Whole numbers with commas between."""
    parts = [part.strip() for part in text.split(",")]
    if not all(part.isdecimal() and int(part) >= least for part in parts):
        raise typer.BadParameter(
            f"whole numbers >= {least} with commas between are allowed, got {text!r}", param_hint=option
        )
    return [int(part) for part in parts]
