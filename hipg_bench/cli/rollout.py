"""``hipg-bench rollout``."""

from __future__ import annotations

from typing import Annotated

import typer

from hipg_bench.cli import console
from hipg_bench.cli.options import AgentOption, NumAgentsOption, PluginOption, SetOption, TaskOption, task_for


def rollout(
    out: Annotated[
        str,
        typer.Option(help="A new .npz file, or the name of a Minari data set such as hipg/nav/expert-v0."),
    ],
    task: TaskOption = None,
    agent: AgentOption = "mappo_minhealth",
    episodes: Annotated[int, typer.Option(min=1, help="Number of episodes.")] = 64,
    seed: Annotated[
        int,
        typer.Option(min=0, help="Seed of the first 64 worlds; scores are measured with seeds from 1000 on."),
    ] = 0,
    train_seed: Annotated[
        int | None, typer.Option(min=0, help="Training seed of the agent's policy; by default the first one.")
    ] = None,
    num_agents: NumAgentsOption = None,
    setting: SetOption = None,
    plugin: PluginOption = None,
    threads: Annotated[int, typer.Option(min=0, help="Physics threads; 0 uses all cores.")] = 0,
) -> None:
    """Play episodes and save every step: observations, actions, rewards, health, joint states."""
    import numpy as np

    from hipg_bench.evaluation import trajectories
    from hipg_bench.evaluation.episodes import EvaluationJob
    from hipg_bench.policies.trained import find_agent

    trajectories.check_target(out)
    who = find_agent(agent)
    spec = task_for(who, task, num_agents, setting)
    policy = who.chosen_policy(spec, train_seed)
    job = EvaluationJob(seed, episodes, threads=threads)
    with console.progress() as bars:
        bar = bars.add_task(f"play {spec.task}", total=episodes)
        played = list(trajectories.trajectories(spec, policy, job, lambda done: bars.advance(bar, done)))
    trajectories.write(out, spec, who.name, played)
    steps = sum(len(one.reward) for one in played)
    mean = float(np.mean([one.reward.sum() for one in played]))
    console.say(f"{out}: {len(played)} episodes, {steps:,} steps, mean return {mean:.2f}")
