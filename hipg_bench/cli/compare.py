"""``hipg-bench compare``."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from hipg_bench.cli import console
from hipg_bench.cli.options import PluginOption
from hipg_bench.errors import HipgError

if TYPE_CHECKING:
    from hipg_bench.policies.bundle import Agent


def compare(
    what: Annotated[
        list[str],
        typer.Argument(help="Folders that `evaluate` wrote, or agents, which are evaluated first."),
    ],
    episodes: Annotated[
        int, typer.Option(min=1, help="Episodes per task and training seed of agents that are evaluated.")
    ] = 320,
    plugin: PluginOption = None,
) -> None:
    """Rank evaluations on the tasks that all played; compare the first with the others, world by world."""
    from hipg_bench.evaluation import comparing, ranking

    folders = _folders(what, episodes)
    found = comparing.on_common_tasks(folders)
    names = list(found)
    tasks = [task["task"] for task in found[names[0]]["tasks"]]
    console.say(f"ranked on what all played: {', '.join(tasks)}\n")
    table = console.table("place", "evaluation", "kind", ">score (IQM)", "", ">runs per task")
    for one in ranking.rank(found):
        place = "-" if one.place is None else str(one.place)
        table.add_row(
            place, one.name, one.kind, console.number(one.score), console.interval(one.ci95),
            _range([len(task["runs"]) for task in found[one.name]["tasks"]]),
        )  # fmt: skip
    console.show(table)
    for name in names[1:]:
        console.say(f"\n{names[0]} against {name}")
        console.say(_verdict(found[names[0]], found[name]))
        rows = console.table("task", ">difference of scores", "")
        for task, (difference, interval) in comparing.differences(folders[names[0]], folders[name]).items():
            rows.add_row(task, f"{difference:+.3f}", console.interval(interval, 3))
        console.show(rows)


def _verdict(ours: Mapping[str, Any], theirs: Mapping[str, Any]) -> str:
    """How often a run of ours beats one of theirs; of single runs nothing is said about other runs."""
    from hipg_bench.evaluation import ranking

    if all(len(task["runs"]) == 1 for side in (ours, theirs) for task in side["tasks"]):
        pairs = list(zip(ours["tasks"], theirs["tasks"], strict=True))
        higher = sum(a["score"] > b["score"] for a, b in pairs)
        return (
            f"one run of each: the first scores higher on {higher} of {len(pairs)} tasks; intervals are over "
            f"episodes, and say nothing of how other training runs would do"
        )
    chance, ends = ranking.better(ours, theirs)
    return f"P(improvement) {chance:.2f} {console.interval(ends)}"


def _range(counts: list[int]) -> str:
    return str(counts[0]) if len(set(counts)) == 1 else f"{min(counts)} to {max(counts)}"


def _folders(what: list[str], episodes: int) -> dict[str, Path]:
    """Name to evaluation; agents are evaluated on what the others played, in the same worlds.

    Raises:
        HipgError: fewer than two, one named twice, or agents that have no task in common.
    """
    from hipg_bench.evaluation import comparing
    from hipg_bench.policies.trained import find_agent

    if len(set(what)) < max(2, len(what)):
        raise HipgError("compare takes two or more different evaluations or agents")
    folders = {name: Path(name) for name in what if (Path(name) / "results.json").is_file()}
    agents = {name: find_agent(name) for name in what if name not in folders}
    done = [comparing.read(folder) for folder in folders.values()]
    tasks = [[task["task"] for task in results["tasks"]] for results in done]
    tasks += [list(agent.tasks) for agent in agents.values()]
    common = [task for task in tasks[0] if all(task in others for others in tasks)]
    if not common:
        raise HipgError(f"{', '.join(what)} have no task in common")
    worlds = {
        "seed": done[0]["seed"] if done else 1000,
        "episodes": done[0]["episodes_per_policy"] if done else episodes,
        "split": done[0]["split"] if done else "standard",
    }
    if worlds["seed"] is None:
        raise HipgError(f"{what[0]} is of hidden worlds: nobody else can be evaluated in them")
    for name, agent in agents.items():
        folders[name] = _evaluated(agent, common, worlds)
    return {name: folders[name] for name in what}


def _evaluated(agent: Agent, tasks: list[str], worlds: Mapping[str, Any]) -> Path:
    """The folder of an evaluation; one of the same policies in the same worlds is used again."""
    from hipg_bench import registry
    from hipg_bench.evaluation import runner
    from hipg_bench.evaluation.episodes import EvaluationJob

    specs = tuple(registry.task_spec(task) for task in tasks)
    policies = [agent.fingerprint(spec.task, k) for spec in specs for k in agent.train_seeds(spec.task)]
    key = json.dumps([worlds, policies, [(spec.task, spec.fingerprint) for spec in specs]])
    digest = hashlib.sha256(key.encode()).hexdigest()[:8]
    folder = Path("runs") / f"compare-{agent.name}-{digest}"
    job = EvaluationJob(**worlds)
    with console.progress() as bars:
        totals = {task: job.episodes * len(agent.train_seeds(task)) for task in tasks}
        ids = {task: bars.add_task(task, total=total) for task, total in totals.items()}
        runner.evaluate(
            agent, runner.Suite("custom", specs), folder, job,
            progress=lambda stage, done: bars.advance(ids[stage], done) if stage in ids else None,
        )  # fmt: skip
    return folder
