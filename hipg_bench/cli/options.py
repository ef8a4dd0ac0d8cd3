"""Options that several commands share: which agent, which task, with which numbers."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from hipg_bench.errors import SpecError

if TYPE_CHECKING:
    from hipg_bench.launchers import Launcher
    from hipg_bench.policies.bundle import Agent
    from hipg_bench.spec import TaskSpec


def _complete_agent(incomplete: str) -> list[str]:
    from hipg_bench.policies.bundle import agents

    return [name for name in agents() if name.startswith(incomplete)]


def complete_task(incomplete: str) -> list[str]:
    """Names of tasks that begin so, for a shell."""
    from hipg_bench.registry import tasks

    return [name for name in tasks() if name.startswith(incomplete)]


AgentOption = Annotated[
    str,
    typer.Option(
        help="A bundled agent's name, or the path of a bundle, a training run's folder or a policy file.",
        autocompletion=_complete_agent,
    ),
]
TaskOption = Annotated[
    str | None,
    typer.Option(
        help="A task's name or a task file (.toml); by default the one that the agent was trained on.",
        autocompletion=complete_task,
    ),
]
TaskArgument = Annotated[
    str, typer.Argument(help="A task's name or a task file (.toml).", autocompletion=complete_task)
]
AgentArgument = Annotated[
    str, typer.Argument(help="A bundled agent's name or a bundle's folder.", autocompletion=_complete_agent)
]
NumAgentsOption = Annotated[
    int | None, typer.Option(min=2, max=31, help="Number of agents, if it differs from the task's.")
]
SetOption = Annotated[
    list[str] | None,
    typer.Option("--set", help="Change a number of the task, as name=value; may be repeated."),
]


def _add_plugins(plugins: list[str] | None) -> list[str] | None:
    from hipg_bench.families.known import add_plugin

    for plugin in plugins or []:
        add_plugin(plugin)
    _plugins[:] = plugins or []
    return plugins


_plugins: list[str] = []
"""The plug-ins of this command."""


PluginOption = Annotated[
    list[str] | None,
    typer.Option(
        "--plugin",
        callback=_add_plugins,
        is_eager=True,
        help="A module, or its file (.py), with a family of your own; may be repeated.",
    ),
]

LauncherOption = Annotated[
    str,
    typer.Option(
        "--launcher",
        help="Where jobs run: local (processes of this machine), ray or slurm; "
        "see docs/guides/many_machines.md.",
    ),
]
LauncherOptions = Annotated[
    list[str] | None,
    typer.Option(
        "--launcher-option",
        help="A setting of the launcher as name=value, such as address=auto for ray or "
        "slurm_partition=cpu for slurm; may be repeated.",
    ),
]


def launcher_of(name: str, workers: int | None, options: list[str] | None) -> Launcher:
    """The launcher that was asked for; ``workers`` is by default the number of usable cores.

    Raises:
        SpecError: no such launcher or option.
        HipgError: its library is not installed.
    """
    from hipg_bench.launchers import launcher
    from hipg_bench.processes import usable_cores

    return launcher(name, workers or usable_cores(), parse_pairs(options, "--launcher-option"))


def parse_shard(text: str) -> tuple[int, int]:
    """``I/N`` as the index from 0 and the number of shards.

    Raises:
        SpecError: anything else.
    """
    index, _, count = text.partition("/")
    if not (index.isdecimal() and count.isdecimal() and 1 <= int(index) <= int(count)):
        raise SpecError(f"--shard takes I/N with I from 1 to N, such as 1/8, got {text!r}")
    return int(index) - 1, int(count)


def task_of(task: str, num_agents: int | None = None, changes: list[str] | None = None) -> TaskSpec:
    """The task that a name or file and some changed numbers stand for.

    Raises:
        SpecError: the file, or a change, is not allowed.
        UnknownNameError: no such task.
    """
    from hipg_bench import registry

    if task.endswith(".toml"):
        spec = registry.read_task(task)
        _files[spec.task] = task
    else:
        spec = registry.task_spec(task)
    numbers = parse_pairs(changes)
    if num_agents is not None:
        numbers["num_agents"] = num_agents
    return registry.vary(spec, **numbers)


def task_for(
    agent: Agent, task: str | None, num_agents: int | None = None, changes: list[str] | None = None
) -> TaskSpec:
    """As `task_of`; the default is the only task that the agent plays.

    Raises:
        SpecError: no task is given and the agent plays several, or none that is known.
    """
    if task is None and len(agent.tasks) != 1:
        plays = f"; it plays {', '.join(agent.tasks)}" if agent.tasks else ""
        raise SpecError(f"--task is needed for the agent {agent.name!r}{plays}")
    return task_of(task or agent.tasks[0], num_agents, changes)


def parse_pairs(pairs: list[str] | None, option: str = "--set") -> dict[str, Any]:
    """``name=value`` options; a value that is not JSON is text.

    Raises:
        SpecError: there is no ``=``.
    """
    parsed: dict[str, Any] = {}
    for pair in pairs or []:
        name, equals, value = pair.partition("=")
        if not equals:
            raise SpecError(f"{option} takes name=value, got {pair!r}")
        try:
            parsed[name] = json.loads(value)
        except json.JSONDecodeError:
            parsed[name] = value
    return parsed


def quoted(path: Path | str) -> str:
    """A path or other word as a shell takes it."""
    import shlex

    return shlex.quote(str(path))


def calibrate_hint(task: str) -> str:
    """How to get the score scale of a task that has none, in one line."""
    if task in _files:
        return f"hipg-bench calibrate {quoted(_files[task])}{plugin_options()} --write"
    return "make it a file with hipg-bench tasks copy, then: hipg-bench calibrate FILE.toml --write"


_files: dict[str, str] = {}
"""The file of each task that came from one, by the task's name."""


def task_option(task: str) -> str:
    """``--task FILE`` for a task that came from a file, and the plug-ins that it may need."""
    return (f" --task {quoted(_files[task])}" if task in _files else "") + plugin_options()


def plugin_options() -> str:
    """The options ``--plugin`` of this command, for the next one."""
    return "".join(f" --plugin {quoted(plugin)}" for plugin in _plugins)
