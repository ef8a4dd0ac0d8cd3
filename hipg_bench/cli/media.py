"""``hipg-bench video`` and ``hipg-bench view``."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hipg_bench.cli import console
from hipg_bench.cli.options import AgentOption, NumAgentsOption, PluginOption, SetOption, TaskOption, task_for

if TYPE_CHECKING:
    import numpy as np

    from hipg_bench.env import BatchEnv
    from hipg_bench.policies.policy import Policy

SeedOption = Annotated[int, typer.Option(min=0, help="Evaluation seed.")]
EpisodeOption = Annotated[
    int, typer.Option(min=0, help="Index of the world in the evaluation with that seed.")
]
TrainSeedOption = Annotated[
    int | None, typer.Option(min=0, help="Training seed of the agent's policy; by default the first one.")
]


def video(
    task: TaskOption = None,
    agent: AgentOption = "mappo_minhealth",
    num_agents: NumAgentsOption = None,
    setting: SetOption = None,
    plugin: PluginOption = None,
    episode: EpisodeOption = 0,
    seed: SeedOption = 1000,
    train_seed: TrainSeedOption = None,
    out: Annotated[Path | None, typer.Option(help="Output file, .mp4 or .gif.")] = None,
    width: Annotated[
        int | None, typer.Option(min=64, help="Width in pixels, by default 1280, of a GIF 480.")
    ] = None,
    height: Annotated[
        int | None, typer.Option(min=64, help="Height in pixels, by default 9/16 of the width.")
    ] = None,
    fps: Annotated[
        int | None,
        typer.Option(min=1, max=120, help="Frames per second, by default 30, of a GIF 12."),
    ] = None,
) -> None:
    """Play one episode and record a video."""
    from hipg_bench.evaluation.episodes import EvaluationJob
    from hipg_bench.policies.trained import find_agent
    from hipg_bench.rendering import film

    who = find_agent(agent)
    spec = task_for(who, task, num_agents, setting)
    policy = who.chosen_policy(spec, train_seed)
    path = out or Path("runs") / f"{spec.task}-{who.name}-{seed}-{episode}.mp4"
    job = EvaluationJob(seed=seed, episodes=episode + 1, threads=1)
    with console.progress() as bars:
        bar = bars.add_task(f"play {spec.task}", total=1.0)
        row = job.play(spec, policy, [episode], lambda done: bars.advance(bar, done))[0]
        states = job.record(spec, policy, row)
        bar = bars.add_task("film", total=None)
        film.record(
            spec, states, path, agent=who.name, size=_size(width, height), fps=fps,
            end_reason=row["end_reason"],
            progress=lambda done, total: bars.update(bar, completed=done, total=total),
        )  # fmt: skip
    console.say(f"{path}: return {row['return']:.2f}, {row['deaths']} dead, {row['end_reason']}")


def _size(width: int | None, height: int | None) -> tuple[int, int] | None:
    """Width and height, where one of them may be left to the shape of a film; None where both are."""
    if width is None and height is None:
        return None
    if width is None:
        return 2 * round((height or 0) * 8 / 9), height or 0
    return width, height or 2 * round(width * 9 / 32)


def view(
    task: TaskOption = None,
    agent: AgentOption = "mappo_minhealth",
    num_agents: NumAgentsOption = None,
    setting: SetOption = None,
    plugin: PluginOption = None,
    episode: EpisodeOption = 0,
    seed: SeedOption = 1000,
    train_seed: TrainSeedOption = None,
    speed: Annotated[
        float, typer.Option(min=0.05, max=20.0, help="Playback speed relative to real time.")
    ] = 1.0,
) -> None:
    """Show an agent's episodes in an interactive window."""
    from hipg_bench import registry
    from hipg_bench.policies.trained import find_agent
    from hipg_bench.rendering import viewer

    viewer.check_display()
    who = find_agent(agent)
    spec = task_for(who, task, num_agents, setting)
    env = registry.make(spec, 1, seed, threads=1)
    viewer.watch(spec, _rows(env, who.chosen_policy(spec, train_seed), seed, episode), speed=speed)


def _rows(env: BatchEnv, policy: Policy, seed: int, episode: int) -> Iterator[np.ndarray]:
    """State rows of one episode after another, without end."""
    import numpy as np

    while True:
        ids = np.array([episode])
        step = env.reset(ids)
        memory = policy.initial_state(seed, ids, env.num_agents)
        yield env.rows[0]
        over = False
        while not over:
            seen = step.info["state"] if policy.privileged else step.observation
            action, memory = policy.act(seen, memory, step.info["alive"])
            step = env.step(action)
            over = bool(step.terminated[0] or step.truncated[0])
            yield step.info["final_rows"][0] if over else env.rows[0]
        episode += 1
