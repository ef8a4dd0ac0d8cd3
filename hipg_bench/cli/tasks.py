"""``hipg-bench tasks``: what there is to play, and every number of it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from hipg_bench.cli import console
from hipg_bench.cli.options import NumAgentsOption, PluginOption, SetOption, TaskArgument, quoted, task_of
from hipg_bench.errors import SpecError

if TYPE_CHECKING:
    from hipg_bench.layout import Layout
    from hipg_bench.spec import TaskSpec

app = typer.Typer(help="List the tasks, or show the numbers and vectors of one.", no_args_is_help=False)

AsJson = Annotated[bool, typer.Option("--json", help="Print JSON instead of a table.")]


@app.callback(invoke_without_command=True)
def tasks(context: typer.Context, as_json: AsJson = False) -> None:
    """List the tasks, or show the numbers and vectors of one."""
    if context.invoked_subcommand is not None:
        return
    from hipg_bench import registry

    specs = registry.tasks().values()
    if as_json:
        console.show_json([spec.model_dump(mode="json") for spec in specs])
        return
    rows = console.table("task", "suite", ">agents", ">steps", ">random", ">reference", "")
    for spec in specs:
        anchors = spec.anchors
        rows.add_row(
            spec.task, ", ".join(spec.tags), str(spec.num_agents), str(spec.horizon),
            console.number(anchors.random.mean if anchors else None, 1),
            console.number(anchors.reference.mean if anchors else None, 1), spec.summary,
        )  # fmt: skip
    console.show(rows)


@app.command()
def show(
    task: TaskArgument,
    num_agents: NumAgentsOption = None,
    setting: SetOption = None,
    plugin: PluginOption = None,
    as_json: AsJson = False,
) -> None:
    """Show a task's numbers and what its observation, action and joint-state vectors contain."""
    from hipg_bench import registry

    spec = task_of(task, num_agents, setting)
    layout = registry.definition_of(spec).layout
    vectors = {"observation": layout.observation, "action": layout.action, "state": layout.state}
    if as_json:
        blocks = {name: _blocks(vector) for name, vector in vectors.items()}
        console.show_json(spec.model_dump(mode="json") | {"fingerprint": spec.fingerprint, "vectors": blocks})
        return
    console.say(f"{spec.task} v{spec.version} ({spec.fingerprint}): {spec.summary}\n")
    _print_numbers(spec)
    titles = {
        "observation": "observation of one agent", "action": "action of one agent",
        "state": "joint state, for central critics",
    }  # fmt: skip
    for name, vector in vectors.items():
        rows = console.table(
            "field", ">columns", ">size", "shape", "unit", "frame", "visible",
            title=f"\n{titles[name]}: {vector.size} numbers",
        )  # fmt: skip
        for block in _blocks(vector):
            first, last = block["columns"]
            shape = " x ".join(str(size) for size in block["shape"])
            rows.add_row(
                block["name"], f"{first}..{last}" if last > first else str(first), str(block["size"]),
                shape, block["unit"], block["frame"], block["visible"],
            )  # fmt: skip
        console.show(rows)


@app.command()
def copy(
    task: TaskArgument,
    file: Annotated[Path, typer.Argument(help="The new task file, NAME.toml; NAME becomes the task's name.")],
    num_agents: NumAgentsOption = None,
    setting: SetOption = None,
    plugin: PluginOption = None,
) -> None:
    """Copy a task into a new task file, with changed numbers if wanted."""
    from hipg_bench import registry
    from hipg_bench.paths import write_text
    from hipg_bench.spec import TaskSpec, parse, to_toml

    if file.suffix != ".toml" or file.exists():
        reason = "it exists" if file.exists() else "task files end in .toml"
        raise SpecError(f"{file}: {reason}; choose another name")
    spec = task_of(task, num_agents, setting)
    own = spec.model_copy(update={"task": file.stem, "tags": (), "anchors": None, "calibration": {}})
    registry.add_task(parse(TaskSpec, own.model_dump(), str(file)))
    write_text(file, to_toml(own))
    console.say(f"{file}: change what you like, then: hipg-bench calibrate {quoted(file)} --write")


def _blocks(vector: Layout) -> list[dict[str, Any]]:
    """One entry per block; ``columns`` are the first and the last one, from 0."""
    return [
        {
            "name": block.name,
            "columns": [vector.slices[block.name].start, vector.slices[block.name].stop - 1],
            "size": block.size,
            "shape": list(block.shape),
            "unit": block.unit,
            "frame": block.frame,
            "visible": block.visible,
        }
        for block in vector.present
    ]


def _print_numbers(spec: TaskSpec) -> None:
    """Everything of the task file."""
    rows = console.table("number", "value")
    own = (
        "family",
        "tags",
        "num_agents",
        "horizon",
        "control_step",
        "clip_actions",
        "graded_health",
        "floor",
    )
    for name in own:
        value = getattr(spec, name)
        rows.add_row(name, ", ".join(value) if isinstance(value, tuple) else str(value))
    for group in ("params", "weights", "calibration"):
        for name, value in getattr(spec, group).items():
            rows.add_row(f"{group}.{name}", str(value))
    if spec.anchors is not None:
        for name, anchor in (("random", spec.anchors.random), ("reference", spec.anchors.reference)):
            says = f" ({spec.anchors.reference_is})" if name == "reference" else ""
            rows.add_row(
                f"anchors.{name}",
                f"{anchor.mean:.2f} {console.interval(anchor.ci95)} over {anchor.episodes} episodes{says}",
            )
    console.show(rows)
