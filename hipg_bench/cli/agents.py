"""``hipg-bench agents``: who can play."""

from __future__ import annotations

from typing import Annotated, Any

import typer

from hipg_bench.cli import console
from hipg_bench.cli.options import quoted

app = typer.Typer(help="List the bundled agents, or show one.", no_args_is_help=False)

AsJson = Annotated[bool, typer.Option("--json", help="Print JSON instead of a table.")]


@app.callback(invoke_without_command=True)
def agents(context: typer.Context, as_json: AsJson = False) -> None:
    """List the bundled agents, or show one."""
    if context.invoked_subcommand is not None:
        return
    from hipg_bench.policies import bundle

    found = [bundle.load_agent(name) for name in bundle.agents()]
    if as_json:
        console.show_json([_facts(agent) for agent in found])
        return
    rows = console.table("agent", ">tasks", "")
    for agent in found:
        rows.add_row(agent.name, str(len(agent.tasks)), agent.summary)
    console.show(rows)


@app.command()
def show(
    agent: Annotated[str, typer.Argument(help="A bundled agent's name, or the path of a bundle.")],
    as_json: AsJson = False,
) -> None:
    """Show an agent's card and the tasks that it plays."""
    from hipg_bench.policies.bundle import load_agent

    facts = _facts(load_agent(agent))
    if as_json:
        console.show_json(facts)
        return
    console.say(f"{facts['name']}: {facts['summary']}")
    console.say(facts["folder"])
    for name in ("kind", "builtin", "entry_point", "execution", "authors", "license", "link"):
        if facts[name]:
            console.say(f"{name}: {facts[name]}")
    if not facts["tasks"]:
        console.say("it has no policies yet")
        return
    rows = console.table("\ntask", "\ntraining seeds", "\npolicy", "\ntrained again by")
    for task in facts["tasks"]:
        seeds = ", ".join(str(seed) for seed in task["train_seeds"])
        rows.add_row(task["task"], seeds, task["fingerprints"][0], task["command"])
    console.show(rows)


def _facts(agent: Any) -> dict[str, Any]:
    """Everything about an agent, ready for JSON."""
    tasks = [
        {
            "task": task,
            "train_seeds": list(seeds),
            "fingerprints": [agent.fingerprint(task, seed) for seed in seeds],
            "command": _command(agent, task, seeds[0]),
        }
        for task in agent.tasks
        if (seeds := agent.train_seeds(task))
    ]
    return agent.card.model_dump(mode="json") | {"folder": str(agent.folder), "tasks": tasks}


def _command(agent: Any, task: str, seed: int) -> str:
    """The command that trains a policy again, where the bundle has the record of its training."""
    if not (agent.folder / task / f"seed{seed}.json").is_file():
        return ""
    from hipg_bench.policies.bundle import agents

    name = agent.name if agent.name in agents() else quoted(agent.folder)
    return f"hipg-bench reproduce {name} {task} {seed}"
