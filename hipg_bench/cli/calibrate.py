"""``hipg-bench calibrate``."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hipg_bench.cli import console
from hipg_bench.cli.options import NumAgentsOption, PluginOption, SetOption, TaskArgument, task_of
from hipg_bench.errors import SpecError

if TYPE_CHECKING:
    from rich.progress import Progress, TaskID

    from hipg_bench.evaluation.calibration import Calibration
    from hipg_bench.spec import TaskSpec


def calibrate(
    task: TaskArgument,
    num_agents: NumAgentsOption = None,
    setting: SetOption = None,
    plugin: PluginOption = None,
    split: Annotated[
        str,
        typer.Option(help="Split: standard, or measure only the anchors of shift, forced_death or ad_hoc."),
    ] = "standard",
    episodes: Annotated[int, typer.Option(min=1, help="Episodes per measured policy.")] = 1000,
    threads: Annotated[int, typer.Option(min=0, help="Physics threads; 0 uses all cores.")] = 0,
    write: Annotated[bool, typer.Option("--write", help="Write the results into the task file.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON instead of a table.")] = False,
) -> None:
    """Measure a task's score anchors, its hazard sensitivity and the scores of open-loop baselines."""
    from hipg_bench.evaluation import calibration
    from hipg_bench.paths import data_folder, is_installed

    spec = task_of(task, num_agents, setting)
    file = Path(task) if task.endswith(".toml") else data_folder("tasks") / f"{task}.toml"
    if write and file.stem != spec.task:
        raise SpecError("--write is for the numbers of a task file, without --num-agents and --set")
    if write and is_installed() and not task.endswith(".toml"):
        raise SpecError(
            f"--write changes {data_folder('tasks')}, which belongs to the installed package: work in a "
            f"checkout, or copy the numbers of --json into a task file of your own"
        )
    if split != "standard":
        _calibrate_split(spec, split, episodes, threads, write, as_json)
        return
    with console.progress() as bars:
        progress = _advance(bars, episodes)
        measured = calibration.calibrate(spec, episodes, threads=threads, progress=progress)
    if write:
        calibration.write(measured.spec, file)
    if as_json:
        facts = measured.spec.model_dump(mode="json", include={"task", "version", "anchors", "calibration"})
        console.show_json(facts | {"fingerprint": spec.fingerprint, "scores": dict(measured.scores)})
    else:
        _print(measured)


def _calibrate_split(
    spec: TaskSpec, split: str, episodes: int, threads: int, write: bool, as_json: bool
) -> None:
    """Measure a task's anchors in a split."""
    from hipg_bench.evaluation import calibration

    with console.progress() as bars:
        progress = _advance(bars, episodes)
        anchors = calibration.anchors_in(split, spec, episodes, threads=threads, progress=progress)
    if write:
        calibration.write_anchors(split, spec.task, anchors)
    if as_json:
        console.show_json({"task": spec.task, "split": split, "anchors": anchors.model_dump(mode="json")})
        return
    console.say(f"{spec.task} in {split}\n")
    rows = console.table("what", ">value", "95 %", "")
    for name, anchor in (("random", anchors.random), ("reference", anchors.reference)):
        note = f"{anchor.episodes} episodes" if anchor.episodes else anchors.reference_is
        rows.add_row(f"return, {name}", f"{anchor.mean:.2f}", console.interval(anchor.ci95), note)
    console.show(rows)


def _advance(bars: Progress, episodes: int) -> Callable[[str, float], None]:
    """A bar for each name that is told."""
    ids: dict[str, TaskID] = {}

    def progress(name: str, done: float) -> None:
        if name not in ids:
            ids[name] = bars.add_task(name, total=episodes)
        bars.advance(ids[name], done)

    return progress


def _print(measured: Calibration) -> None:
    spec = measured.spec
    anchors, facts = spec.anchors, spec.calibration
    if anchors is None:
        return
    standard = "standard" in spec.tags  # what is wanted of a task; the paper's are as they are
    console.say(f"{spec.task} v{spec.version} ({spec.fingerprint})\n")
    rows = console.table("what", ">value", "95 %", "wanted", "")
    for name, anchor in (("random", anchors.random), ("reference", anchors.reference)):
        note = f"{anchor.episodes} episodes" if anchor.episodes else anchors.reference_is
        rows.add_row(f"return, {name}", f"{anchor.mean:.2f}", console.interval(anchor.ci95), "", note)
    for name, (score, ends) in measured.scores.items():
        probe = name in ("zero", "constant", "time_only")
        rows.add_row(
            f"score, {name}",
            f"{score:.3f}",
            console.interval(ends, 3),
            _wanted(score < 0.2, "< 0.2") if probe and standard else "",
        )
    if "hazard_sensitivity" in facts:
        sensitivity = facts["hazard_sensitivity"]
        rows.add_row(
            "hazard sensitivity",
            f"{sensitivity:.3f}",
            "",
            _wanted(sensitivity >= 0.25, ">= 0.25") if standard else "",
            "score of the hazard-unaware expert without and with the hazard",
        )
        rows.add_row(
            "deaths, hazard-unaware", f"{facts['hazard_unaware_deaths']:.3f}", "", "", "per agent and episode"
        )
    rows.add_row("deaths, random", f"{facts['random_deaths']:.3f}", "", "", "per agent and episode")
    console.show(rows)


def _wanted(met: bool, rule: str) -> str:
    return rule if met else f"{rule} MISSED"
