"""``hipg-bench reproduce``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from hipg_bench.cli import console
from hipg_bench.cli.options import AgentArgument, TaskArgument, quoted


def reproduce(
    agent: AgentArgument,
    task: TaskArgument,
    seed: Annotated[int, typer.Argument(min=0, help="Training seed.")] = 0,
    out: Annotated[
        Path | None, typer.Option(help="Folder of the run, by default runs/reproduce-AGENT-TASK-seedK.")
    ] = None,
    threads: Annotated[int, typer.Option(min=1, help="Threads of physics and of torch.")] = 1,
    show: Annotated[bool, typer.Option("--show", help="Print the run's settings and exit.")] = False,
) -> None:
    """Train a published policy again with its settings, steps and initial policy, and compare the two."""
    import torch

    from hipg_bench.cli.train import train_one
    from hipg_bench.comparison.reproduce import published
    from hipg_bench.policies.bundle import digest, load_agent

    who = load_agent(agent)
    run = published(who, task, seed)
    versions = ", ".join(f"{name} {version}" for name, version in run.versions.items())
    console.say(
        f"published: {run.seconds / 60:.0f} minutes on {run.machine or 'an unknown machine'}; {versions}"
    )
    if show:
        console.show_json(run.settings.model_dump(mode="json"))
        return
    torch.set_num_threads(threads)
    folder = out or Path("runs") / f"reproduce-{who.name}-{task}-seed{seed}"
    command = f"hipg-bench reproduce {quoted(agent)} {task} {seed} --out {quoted(folder)}"
    train_one(run.settings, folder, command)
    if digest(folder / "policy.safetensors") == digest(run.policy):
        console.say("the policy is the published one, byte for byte")
    else:
        score = "" if run.score is None else f", whose score is {run.score:.2f} over its own episodes"
        console.say(
            f"the policy differs from the published one{score}: runs are equal on one machine with the same "
            f"versions, and close elsewhere"
        )
