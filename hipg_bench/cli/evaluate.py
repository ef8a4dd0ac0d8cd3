"""``hipg-bench evaluate``."""

from __future__ import annotations

import dataclasses
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from hipg_bench.cli import console
from hipg_bench.cli.options import (
    AgentOption,
    LauncherOptions,
    NumAgentsOption,
    PluginOption,
    SetOption,
    calibrate_hint,
    launcher_of,
    parse_shard,
    task_of,
)
from hipg_bench.errors import SpecError

if TYPE_CHECKING:
    from hipg_bench.evaluation.episodes import EvaluationJob
    from hipg_bench.evaluation.runner import Suite
    from hipg_bench.launchers import Launcher
    from hipg_bench.policies.bundle import Agent

_QUICK = 32


def evaluate(
    agent: AgentOption = "mappo_minhealth",
    tasks: Annotated[
        str | None,
        typer.Option(
            "--tasks",
            "--task",
            help="Task names or task files (.toml) with commas between, a tag such as standard, or all. "
            "By default the standard tasks, and for a training run its own.",
        ),
    ] = None,
    num_agents: NumAgentsOption = None,
    setting: SetOption = None,
    plugin: PluginOption = None,
    split: Annotated[
        str,
        typer.Option(
            help="Split: standard, shift, forced_death, ad_hoc, or all, which writes one folder per split."
        ),
    ] = "standard",
    episodes: Annotated[int, typer.Option(min=1, help="Episodes per task and training seed.")] = 320,
    seed: Annotated[int, typer.Option(min=0, help="Evaluation seed of the first 64 worlds.")] = 1000,
    num_envs: Annotated[
        int, typer.Option(min=1, help="Worlds simulated at once, at most 64. Results do not depend on it.")
    ] = 64,
    threads: Annotated[
        int, typer.Option(min=0, help="Physics threads; 0 uses all cores. Results do not depend on it.")
    ] = 0,
    out: Annotated[
        Path | None, typer.Option(help="Output folder. An interrupted evaluation in it is resumed.")
    ] = None,
    video: Annotated[
        int | None, typer.Option(min=0, help="Videos per task; by default 1, or 0 with --quick.")
    ] = None,
    quick: Annotated[
        bool,
        typer.Option(
            "--quick", help="Play 32 episodes without videos, for a first look and not for comparisons."
        ),
    ] = False,
    shard: Annotated[
        str | None,
        typer.Option(
            help="I/N: play only part I of N, counted from 1, into the same --out on a shared disk. "
            "The process that finishes last writes the results."
        ),
    ] = None,
    launcher: Annotated[
        str | None,
        typer.Option(
            help="Play in many processes: local, ray or slurm (the last two are untried); "
            "see docs/guides/many_machines.md."
        ),
    ] = None,
    launcher_option: LauncherOptions = None,
    workers: Annotated[
        int | None,
        typer.Option(min=1, help="Processes at a time with --launcher or --shard; by default one per core."),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print results.json instead of the table.")] = False,
) -> None:
    """Evaluate an agent on tasks; write scores, episode rows, videos and a report."""
    from hipg_bench.evaluation import runner, splits
    from hipg_bench.evaluation.episodes import EvaluationJob
    from hipg_bench.paths import new_folder
    from hipg_bench.policies.trained import Trained, find_agent

    who = find_agent(agent)
    if tasks is None:
        tasks = ",".join(who.tasks) if isinstance(who, Trained) and who.tasks else "standard"
    suite = suite_of(tasks, num_agents, setting)
    job = EvaluationJob(seed, _QUICK if quick else episodes, num_envs, threads)
    films = (0 if quick else 1) if video is None else video
    for name in splits.SPLITS if split == "all" else (split,):
        runner.playable(who, suite, name)
    folder = out or new_folder(Path("runs"), f"{who.name}-{time.strftime('%Y%m%d-%H%M%S')}")
    parts = {name: folder / name for name in splits.SPLITS} if split == "all" else {split: folder}
    shared = shard is not None or launcher is not None or workers is not None
    if shared and out is None:
        raise SpecError("--shard, --launcher and --workers need --out, the folder that the processes share")
    every: dict[str, Any] = {}
    for name, part in parts.items():
        split_plan = dataclasses.replace(job, split=name)
        if shared:
            engine = launcher_of(launcher or "local", workers, launcher_option)
            one_thread = dataclasses.replace(split_plan, threads=1)
            if not _play_blocks(who, agent, suite, part, one_thread, engine, shard):
                continue
        every[name] = _evaluate(who, suite, part, split_plan, films, silent=as_json)
    if as_json:
        console.show_json(every if split == "all" else every.get(split))


def _play_blocks(
    who: Agent,
    agent: str,
    suite: Suite,
    folder: Path,
    job: EvaluationJob,
    engine: Launcher,
    shard: str | None,
) -> bool:
    """Play this process's part of an evaluation; return whether the results are left to this process."""
    from hipg_bench import launchers
    from hipg_bench.claims import owner
    from hipg_bench.evaluation import runner
    from hipg_bench.policies.bundle import agents

    name = agent if agent in agents() else str(Path(agent).resolve())
    every = runner.prepare(who, name, suite, folder, job)
    index, count = (0, 1) if shard is None else parse_shard(shard)
    mine = {block.folder: block for block in every[index::count]}
    with console.progress() as bars:
        bar = bars.add_task(job.split, total=len(mine))

        def report() -> None:
            bars.update(bar, completed=sum(block.finished for block in mine.values()))

        jobs = [block.launcher_job() for block in mine.values()]
        launchers.work_off(jobs, engine, lambda one: mine[one.folder].finished, report)
    left = sum(not block.finished for block in every)
    writer = owner(folder)
    if left:
        console.warn(f"{folder}: {left} of {len(every)} blocks are left to other shards")
    elif writer is not None and writer.alive:
        console.warn(f"{folder}: process {writer.pid} on {writer.host} writes the results")
    return not left and (writer is None or not writer.alive)


def _evaluate(
    who: Agent, suite: Suite, folder: Path, job: EvaluationJob, films: int, *, silent: bool
) -> dict[str, Any]:
    """One split, with a bar for each task; scores are printed as they come, and before the films."""
    from hipg_bench.evaluation import runner

    seeds, skipped = runner.playable(who, suite, job.split)
    if not silent:
        console.say(f"{who.name} on {suite.name}, {job.split}: {who.summary}\n")
        console.say(_line("task", "score", "", "return", "survival", "deaths", "ended by"))
    with console.progress() as bars:
        totals = {task: job.episodes * len(found) for task, found in seeds.items()}
        if films:
            totals["films"] = films * len(seeds)
        ids = {name: bars.add_task(name, total=total) for name, total in totals.items()}

        def played(task: dict[str, Any]) -> None:
            with console.paused(bars):
                console.say(_scores(task))

        def scored(results: dict[str, Any]) -> None:
            with console.paused(bars):
                for task, reason in skipped.items():
                    console.say(_line(task, "-", "", "-", "-", "-", reason))
                _print_summary(results, folder)

        try:
            results = runner.evaluate(
                who, suite, folder, job, films_per_task=films,
                progress=lambda stage, done: bars.advance(ids[stage], done) if stage in ids else None,
                played_task=runner.unheard if silent else played, scored=runner.unheard if silent else scored,
            )  # fmt: skip
        except KeyboardInterrupt:
            if (folder / "results.json").is_file():
                console.warn(f"hipg-bench: the same command with --out {folder} resumes")
            raise
    for trouble in results["film_trouble"]:
        console.warn(f"no film: {trouble}")
    if films and not silent:
        console.say(f"{len(results['films'])} films in {folder / 'videos'}")
    return results


_WIDTHS = (20, -6, -14, -8, -8, -6, 1)
"""Of a line's cells; negative ones are aligned to the right."""


def _line(*cells: str) -> str:
    """Cells as a line of the table, which is printed row by row."""
    padded = (
        cell.rjust(-width) if width < 0 else cell.ljust(width)
        for cell, width in zip(cells, _WIDTHS, strict=True)
    )
    return "  ".join(padded).rstrip()


def _scores(task: dict[str, Any]) -> str:
    """What came of a task, as a line of the table."""
    number, interval = console.number, console.interval
    return _line(
        task["task"], number(task["score"]), interval(task["score_ci95"]), number(task["return_mean"], 1),
        f"{100 * task['survival']:.0f} %", number(task["deaths"]),
        ", ".join(f"{reason} {count}" for reason, count in task["end_reasons"].items()),
    )  # fmt: skip


def suite_of(tasks: str, num_agents: int | None = None, changes: list[str] | None = None) -> Suite:
    """The tasks named on the command line, with the numbers given there.

    Raises:
        SpecError: a task file or a number that is not allowed.
        UnknownNameError: no such task or tag.
    """
    from hipg_bench import registry
    from hipg_bench.evaluation.runner import Suite

    tags = {tag for spec in registry.tasks().values() for tag in spec.tags}
    name, names = tasks, list(registry.tasks())
    if tasks in tags:
        names = list(registry.tagged(tasks))
    elif tasks != "all":
        name, names = "custom", [part.strip() for part in tasks.split(",") if part.strip()]
    specs = tuple(task_of(one, num_agents, changes) for one in dict.fromkeys(names))
    own = any(spec.task not in registry.tasks() for spec in specs)
    return Suite("custom" if own else name, specs)


def _print_summary(results: dict[str, Any], folder: Path) -> None:
    """What stands below the table."""
    number, interval = console.number, console.interval
    whole = results["aggregate"]
    if whole["score_iqm"] is not None:
        zero = (
            f", {whole['counted_as_zero']} of them unplayed and counted as 0"
            if whole["counted_as_zero"]
            else ""
        )
        console.say(
            f"\nscore, interquartile mean over {whole['tasks']} task{'s' * (whole['tasks'] != 1)}{zero}: "
            f"{number(whole['score_iqm'])} {interval(whole['score_iqm_ci95'])}"
        )
    for task in results["tasks"]:
        if task["score"] is None:
            name = task["task"]
            console.say(f"no score on {name}, which has no score scale yet: {calibrate_hint(name)}")
    if results["episodes_per_policy"] < 320:
        console.say(f"{results['episodes_per_policy']} episodes per policy: not for comparison")
    console.say(f"\n{folder / 'report.html'}")
