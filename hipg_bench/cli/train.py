"""``hipg-bench train``."""

from __future__ import annotations

import json
from collections.abc import Collection
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from hipg_bench.cli import console
from hipg_bench.cli.options import (
    LauncherOption,
    LauncherOptions,
    NumAgentsOption,
    PluginOption,
    calibrate_hint,
    complete_task,
    launcher_of,
    parse_pairs,
    parse_shard,
    plugin_options,
    quoted,
    task_of,
    task_option,
)
from hipg_bench.errors import SpecError, hint

if TYPE_CHECKING:
    from hipg_bench.launchers import Launcher
    from hipg_bench.learning.settings import AnySettings
    from hipg_bench.spec import TaskSpec


def train(
    task: Annotated[
        str | None, typer.Option(help="A task's name or a task file (.toml).", autocompletion=complete_task)
    ] = None,
    num_agents: NumAgentsOption = None,
    algorithm: Annotated[
        str | None,
        typer.Option(
            "--algorithm",
            "--algo",
            help="MAPPO with one of the credit rules min_health, central (also called mappo), local (also "
            "called ippo), coma, difference_rewards or ma_poca; or maddpg, or qmix. [default: min_health]",
        ),
    ] = None,
    credit: Annotated[
        str | None,
        typer.Option(help="MAPPO with your own credit rule, as module:function, instead of --algorithm."),
    ] = None,
    settings_file: Annotated[
        Path | None,
        typer.Option(
            "--settings",
            help="TOML file of settings that differ from the preset's, such as `hipg-bench settings` prints.",
        ),
    ] = None,
    preset: Annotated[str, typer.Option(help="Preset of settings: recommended or paper.")] = "recommended",
    seed: Annotated[int, typer.Option(min=0, max=999, help="Random seed.")] = 0,
    steps: Annotated[
        int | None, typer.Option(min=1, help="Environment steps; by default the preset's.")
    ] = None,
    setting: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            help="Change a setting of the training or a number of the task, as name=value; may be repeated.",
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            help="Folder of the run, by default runs/TASK-ALGORITHM-seedK. "
            "An unfinished run in it is resumed."
        ),
    ] = None,
    threads: Annotated[
        int,
        typer.Option(
            min=1, help="Threads of physics and PyTorch. Several runs with one thread each are faster."
        ),
    ] = 1,
    sweep: Annotated[
        Path | None, typer.Option(help="Sweep file that lists many runs, instead of --task.")
    ] = None,
    workers: Annotated[
        int | None,
        typer.Option(min=1, help="Runs of a sweep trained at the same time; by default one per core."),
    ] = None,
    track: Annotated[
        list[str] | None, typer.Option(help="Show the run in wandb or trackio too; may be repeated.")
    ] = None,
    shard: Annotated[
        str | None,
        typer.Option(help="I/N: train only part I of N of a sweep, counted from 1."),
    ] = None,
    plugin: PluginOption = None,
    launcher: LauncherOption = "local",
    launcher_option: LauncherOptions = None,
    status: Annotated[bool, typer.Option("--status", help="Show the sweep's progress and exit.")] = False,
) -> None:
    """Train one run or a sweep. Run the same command again to resume."""
    if (task is None) == (sweep is None) or (status and sweep is None):
        raise SpecError("train takes either --task or --sweep; --status belongs to the latter")
    from hipg_bench.processes import usable_cores

    if sweep is None and (shard is not None or launcher != "local"):
        raise SpecError("--shard and --launcher belong to --sweep")
    if sweep is not None and status:
        _tell(sweep, out or Path("runs") / sweep.stem, workers or usable_cores())
        return
    if sweep is not None:
        engine = launcher_of(launcher, workers, launcher_option)
        _train_many(sweep, out or Path("runs") / sweep.stem, engine, shard)
        return

    import torch

    from hipg_bench.learning.settings import PRESETS, SYNONYMS, read_settings, settings_type

    torch.set_num_threads(threads)
    if preset not in PRESETS:
        raise SpecError(f"no preset {preset!r}{hint(preset, PRESETS)}")
    given = {} if settings_file is None else read_settings(settings_file)
    algorithm = _algorithm(algorithm, credit, given)
    algorithm = SYNONYMS.get(algorithm, algorithm)
    fields = settings_type(algorithm).model_fields
    pairs = [pair for pair in setting or [] if pair.partition("=")[0] not in fields]
    spec = _task(str(task), num_agents, pairs, fields)
    own = [pair for pair in setting or [] if pair not in pairs]
    plain = PRESETS[preset](spec.task, algorithm=algorithm).model_dump(mode="json")
    given = {name: value for name, value in given.items() if name not in plain or value != plain[name]}
    changes: dict[str, Any] = {**given, "algorithm": algorithm, "seed": seed, **parse_pairs(own)}
    if steps is not None:
        changes["steps"] = steps
    settings = PRESETS[preset](spec.task, **changes)
    folder = out or Path("runs") / "-".join(
        [
            spec.task,
            algorithm.replace(":", "."),
            *([preset] if preset != "recommended" else []),
            f"seed{seed}",
        ]
    )
    options = [
        f"--task {quoted(str(task))}{plugin_options()}",
        *([] if num_agents is None else [f"--num-agents {num_agents}"]),
        f"--algorithm {algorithm}",
        f"--preset {preset}",
        f"--seed {seed}",
        *(f"--set {quoted(f'{name}={json.dumps(value)}')}" for name, value in given.items()),
        *(f"--set {quoted(pair)}" for pair in setting or []),
    ]
    command = " ".join(["hipg-bench train", *options, f"--steps {settings.steps}", f"--out {quoted(folder)}"])
    train_one(settings, folder, command, tuple(track or ()))


def _algorithm(algorithm: str | None, credit: str | None, given: dict[str, Any]) -> str:
    """The algorithm that options or a settings file name, by default min_health.

    Raises:
        SpecError: --credit is given beside --algorithm, or is not module:function.
    """
    if credit is None:
        return algorithm or str(given.get("algorithm", "min_health"))
    if algorithm is not None or ":" not in credit:
        raise SpecError(f"--credit takes module:function, without --algorithm beside it, got {credit!r}")
    return credit


def _task(task: str, num_agents: int | None, pairs: list[str], settings: Collection[str]) -> TaskSpec:
    """The task with some numbers changed.

    Raises:
        SpecError: a name that is neither the task's nor one of the learner's settings.
    """
    numbers = task_of(task).numbers
    for name in parse_pairs(pairs):
        if name not in numbers:
            raise SpecError(
                f"--set {name}: neither a setting of this training nor a number of {task}"
                f"{hint(name, [*settings, *numbers])}"
            )
    return task_of(task, num_agents, pairs)


def train_one(settings: AnySettings, out: Path, command: str, track: tuple[str, ...] = ()) -> None:
    """Train one run with a progress display, and print what came of it."""
    from hipg_bench.learning.run import train as run

    if _is_finished(settings, out):
        console.say(
            f"{out} is finished already: {settings.steps:,} environment steps. "
            f"Another --seed or --out begins a new run."
        )
        _print_result(settings, out)
        return
    console.say(
        f"{settings.task}, algorithm {settings.algorithm}, seed {settings.seed}: "
        f"{settings.steps:,} environment steps into {out}"
    )
    with console.progress() as bars:
        bar = bars.add_task("training", total=settings.iterations)

        def report(iteration: int, log: dict[str, float]) -> None:
            bars.update(bar, completed=iteration, description=f"return {log.get('return', float('nan')):.4g}")

        run(settings, out, command=command, report=report, track=track)
    _print_result(settings, out)


def _is_finished(settings: AnySettings, out: Path) -> bool:
    """Whether a folder holds this very run, with all its steps."""
    from hipg_bench.policies.trained import RECORD, read_record

    if not (out / RECORD).is_file():
        return False
    record = read_record(out)
    return record.env_steps >= settings.steps and record.settings.model_dump() | {
        "steps": settings.steps,
        "eval_every": settings.eval_every,
    } == json.loads(settings.model_dump_json())


def _print_result(settings: AnySettings, out: Path) -> None:
    """How good the policy is, where it lies, and what to do with it."""
    from hipg_bench.learning.run import last_evaluation
    from hipg_bench.policies.bundle import agents, load_agent
    from hipg_bench.registry import tagged

    found = last_evaluation(out)
    if found is not None:
        at = f"over {found.episodes} episodes without exploration, after {found.steps:,} steps"
        if found.score is None:
            console.say(f"return {found.mean_return:.2f} {at}")
            console.say(f"{settings.task} has no score scale yet: {calibrate_hint(settings.task)}")
        else:
            console.say(
                f"score {found.score:.2f} {console.interval(found.score_ci95)}, "
                f"return {found.mean_return:.2f} {at}"
            )
    console.say(f"policy: {out / 'policy.safetensors'}, curve: {out / 'curve.csv'}")
    run = quoted(out) + task_option(settings.task)
    console.say("next:")
    console.say(f"  hipg-bench evaluate --agent {run}")
    console.say(f"  hipg-bench video --agent {run} --out {quoted(out / 'film.mp4')}")
    reference = "mappo_minhealth"
    if reference in agents() and settings.task in load_agent(reference).tasks:
        console.say(f"  hipg-bench compare {quoted(out)} {reference}")
    if settings.task in tagged("standard"):
        console.say(f"  hipg-bench submit init my_agent --from-run {quoted(out)} --authors YOU --license MIT")


def _train_many(sweep: Path, out: Path, engine: Launcher, part: str | None) -> None:
    from hipg_bench.learning.sweep import Run, load, shard, work_off
    from hipg_bench.paths import write_text

    runs = load(sweep, out)
    write_text(out / "sweep.toml", sweep.read_text(encoding="utf-8"))  # what `status` reads
    if part is not None:
        index, count = parse_shard(part)
        runs = shard(runs, index, count)
    left = sum(not run.finished for run in runs)
    at_a_time = "" if engine.slots is None else f", {engine.slots} at a time"
    console.say(f"{sweep.name}: {left} of {len(runs)} runs to do{at_a_time}, into {out}")
    with console.progress() as bars:
        bar = bars.add_task("training", total=sum(run.settings.steps for run in runs))

        def report(runs: list[Run]) -> None:
            done = [min(run.done, run.settings.steps) for run in runs]
            ended = sum(steps >= run.settings.steps for steps, run in zip(done, runs, strict=True))
            bars.update(bar, completed=sum(done), description=f"{ended}/{len(runs)} runs")

        work_off(runs, engine, report)
    console.say(f"{len(runs)} runs are finished in {out}")


def _tell(sweep: Path, out: Path, workers: int) -> None:
    import time

    from hipg_bench.learning.sweep import load, standings

    found = standings(load(sweep, out), time.time())
    rows = console.table(
        "task", "algorithm", ">seed", "state", ">steps", ">minutes", ">left", title=sweep.name
    )
    for one in found:
        settings = one.run.settings
        rows.add_row(
            settings.task,
            one.run.algorithm,
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
