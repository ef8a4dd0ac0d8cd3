"""``hipg-bench bench``."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from hipg_bench.cli import console, outputs
from hipg_bench.errors import UnknownNameError, hint

if TYPE_CHECKING:
    from hipg_bench.evaluation.bench.child import Job
    from hipg_bench.evaluation.bench.plan import BenchmarkPlan

_PICTURES = (".png", ".svg", ".pdf")
_MEMORY = {">peak MB": "{peak_mb:,.0f}"}
_COLUMNS: Mapping[str, dict[str, str]] = {
    "steps": {
        "task": "{task}",
        ">threads": "{threads}",
        ">worlds": "{num_envs:,}",
        ">env-steps/s": "{env_steps:,.0f}",
        ">agent-steps/s": "{agent_steps:,.0f}",
        ">raw physics": "{raw_steps:,.0f}",
        ">share": "{share:.0%}",
        **_MEMORY,
    },
    "reset": {
        "task": "{task}",
        ">threads": "{threads}",
        ">worlds": "{num_envs:,}",
        ">make ms": "{make_ms:,.0f}",
        ">reset ms": "{reset_ms:,.2f}",
        ">us per world": "{per_world_us:,.0f}",
        ">in steps": "{in_steps:.2f}",
        **_MEMORY,
    },
    "render": {
        "task": "{task}",
        ">pixels": "{width}x{height}",
        "backend": "{backend}",
        ">film ms/frame": "{film_ms:.1f}",
        ">bare ms/frame": "{bare_ms:.1f}",
        ">over bare": "{over_bare:+.0%}",
        ">first frame s": "{start_s:.1f}",
        **_MEMORY,
    },
    "train": {
        "task": "{task}",
        "algorithm": "{algorithm}",
        ">threads": "{threads}",
        ">worlds x steps": "{num_envs} x {rollout}",
        ">s per iteration": "{seconds:.2f}",
        ">rollout": "{rollout_share:.0%}",
        ">credit": "{credit_share:.0%}",
        ">update": "{update_share:.0%}",
        ">agent-steps/s": "{agent_steps:,.0f}",
        **_MEMORY,
    },
    "evaluate": {
        "agent": "{agent}",
        "task": "{task}",
        ">threads": "{threads}",
        ">episodes": "{episodes}",
        ">seconds": "{seconds:.1f}",
        ">episodes/s": "{episodes_per_second:.1f}",
        **_MEMORY,
    },
    "start": {
        "what": "{what}",
        ">ms": "{ms:,.0f}",
        ">beyond python": "{beyond_python_ms:,.0f}",
        "slowest imports, ms": "{imports}",
    },
    "adapters": {
        "adapter": "{adapter}",
        "task": "{task}",
        ">threads": "{threads}",
        ">worlds": "{num_envs}",
        ">us per step": "{step_us:,.0f}",
        ">BatchEnv": "{batch_us:,.0f}",
        ">over it": "{overhead:+.0%}",
    },
    "scaling": {
        "task": "{task}",
        "against": "{sweep}",
        ">agents": "{num_agents}",
        ">worlds": "{num_envs:,}",
        ">us per world and step": "{step_us:,.1f}",
        ">growth": "{growth:.2f}",
        ">per agent": "{growth_per_agent:.2f}",
    },
}
"""Section to what its table shows: column, and how it is made of a row."""


def bench(
    sections: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[SECTION]...", help=f"Sections to measure: {', '.join(_COLUMNS)}. [default: all]"
        ),
    ] = None,
    tasks: Annotated[
        str | None,
        typer.Option(help="Comma-separated task names, or standard, paper or all. [default: standard]"),
    ] = None,
    num_envs: Annotated[
        str | None, typer.Option(help="Comma-separated numbers of worlds. [default: 1,64,1024]")
    ] = None,
    threads: Annotated[
        str | None,
        typer.Option(help="Comma-separated numbers of physics threads; 0 uses all cores. [default: 0]"),
    ] = None,
    seconds: Annotated[
        float | None, typer.Option(min=0.05, help="Seconds per measurement. [default: 1]")
    ] = None,
    full: Annotated[
        bool,
        typer.Option(
            "--full", help="Measure all tasks, up to 4096 worlds and 1 to all threads; takes half an hour."
        ),
    ] = False,
    plot: Annotated[
        Path | None, typer.Option(help="Draw how speed scales into this .png, .svg or .pdf file.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON instead of tables.")] = False,
) -> None:
    """Measure speed and memory, each beside its upper bound."""
    wanted = _checked_sections(sections)
    if plot is not None:
        outputs.check_free(plot, outputs.PICTURE)
    if plot is not None and plot.suffix.lower() not in _PICTURES:
        raise typer.BadParameter(
            f"a name that ends in {', '.join(_PICTURES)}, got {plot}", param_hint="--plot"
        )
    batches, counts = _numbers(num_envs, "--num-envs", 1), _numbers(threads, "--threads", 0)

    from hipg_bench.cli.evaluate import suite_of
    from hipg_bench.evaluation.bench import plan
    from hipg_bench.evaluation.bench.child import run
    from hipg_bench.evaluation.bench.machine import machine

    specs = suite_of(tasks or ("all" if full else "standard")).specs
    asked = plan.make_plan(specs, num_envs=batches, threads=counts, seconds=seconds, full=full)
    jobs = {name: _jobs(name, asked) for name in wanted}
    rows: dict[str, list[Any]] = {name: [] for name in wanted}
    host, started = machine(), time.monotonic()
    with console.progress() as bars:
        bar = bars.add_task("bench", total=sum(len(of_section) for of_section in jobs.values()))
        for name in wanted:
            for job in jobs[name]:
                bars.update(bar, description=name)
                rows[name] += run(job)
                bars.advance(bar)
            if not as_json:
                _show(name, rows[name])
    document = plan.document(asked, rows, host, time.monotonic() - started)
    if as_json:
        console.show_json(document)
    else:
        busy = f"load {host['load']} before" if host["load"] > host["cores"] / 4 else "idle before"
        console.say(f"\n{host['processor']}, {host['cores']} cores, {busy}")
    if plot is not None:
        from hipg_bench.evaluation.bench.plot import draw

        draw(document, plot)


def _checked_sections(sections: list[str] | None) -> list[str]:
    """Those named, in the order in which they are measured; all by default."""
    for name in sections or ():
        if name not in _COLUMNS:
            raise UnknownNameError(f"bench has no section {name!r}{hint(name, _COLUMNS)}")
    return [name for name in _COLUMNS if not sections or name in sections]


def _jobs(section: str, asked: BenchmarkPlan) -> list[Job]:
    """The measurements of a section."""
    from hipg_bench.evaluation.bench import plan
    from hipg_bench.evaluation.bench.child import Job

    if section != "train":
        return plan.SECTIONS[section](asked)
    from hipg_bench.learning.bench import iteration_time

    return [
        Job("train", iteration_time, (spec.task, count, asked.seconds))
        for spec in asked.examples
        for count in (asked.threads if asked.full else (1,))
    ]


def _show(section: str, rows: list[Any]) -> None:
    """A section's table."""
    columns = _COLUMNS[section]
    shown = console.table(*columns, title=f"\n{section}")
    for row in rows:
        values = dataclasses.asdict(row)
        if left_out := values.get("left_out"):
            console.warn(f"{values['adapter']}: left out, {left_out}")
            continue
        shown.add_row(*(template.format(**values) for template in columns.values()))
    console.show(shown)


def _numbers(text: str | None, option: str, least: int) -> list[int]:
    """Whole numbers with commas between."""
    parts = [part.strip() for part in text.split(",")] if text is not None else []
    if not all(part.isdecimal() and int(part) >= least for part in parts):
        raise typer.BadParameter(
            f"whole numbers >= {least} with commas between are allowed, got {text!r}", param_hint=option
        )
    return [int(part) for part in parts]
