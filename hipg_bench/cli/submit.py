"""``hipg-bench submit``: from a trained agent to a file for the leaderboard."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hipg_bench.cli import console, outputs
from hipg_bench.cli.options import quoted

if TYPE_CHECKING:
    from hipg_bench.submissions.findings import Finding

app = typer.Typer(
    help="Create, check and pack an agent for the leaderboard (docs/guides/submit.md).", no_args_is_help=True
)

Folder = Annotated[Path, typer.Argument(help="The agent's folder, with agent.toml.")]
Trust = Annotated[
    bool, typer.Option("--trust", help="Run the agent's code without a sandbox; only for your own code.")
]
_STYLES = {"error": "bold red", "advice": "yellow", "fine": "green"}


@app.command()
def init(
    name: Annotated[Path, typer.Argument(help="New folder; its name is the agent's name.")],
    tier: Annotated[
        int,
        typer.Option(min=0, max=2, help="Kind of agent: 0 declared network, 1 ONNX, 2 Python in a sandbox."),
    ] = 0,
    authors: Annotated[str, typer.Option(help="Authors of the agent.")] = "",
    license: Annotated[str, typer.Option(help="Licence, such as MIT or Apache-2.0.")] = "",
    summary: Annotated[str, typer.Option(help="Summary of the agent in one sentence.")] = "",
    from_run: Annotated[
        list[Path] | None,
        typer.Option(
            help="A training run of `hipg-bench train`, whose policy it gets; may be repeated for others."
        ),
    ] = None,
) -> None:
    """Make an agent's folder: of training runs, or to be filled in."""
    from hipg_bench.submissions.init import init as make

    runs = from_run or []
    for path in make(name, tier, authors=authors, license=license, summary=summary, runs=runs):
        console.say(str(path))
    for k, step in enumerate(_next_steps(name, tier, bool(runs), authors, license, summary), start=1):
        console.say(f"{k}. {step}")


_WEIGHTS = (
    "write <task>/seed<k>.safetensors into {name}, such as {name}/hazard_nav-4/seed0.safetensors: "
    "docs/guides/submit.md shows how; or begin from a training run, with --from-run",
    "write <task>/seed<k>.onnx into {name}, such as {name}/hazard_nav-4/seed0.onnx: "
    "docs/guides/submit.md shows how",
    "write {name}/agent.py, and name its tasks and training seeds under [tasks] in {name}/agent.toml",
)


def _next_steps(
    name: Path, tier: int, filled: bool, authors: str, license: str, summary: str
) -> Iterator[str]:
    """What is left to do, in order."""
    word = quoted(name)
    if not filled:
        yield _WEIGHTS[tier].format(name=word)
    fields = {"authors": authors, "license": license, "summary": summary or filled}
    missing = [field for field, given in fields.items() if not given]
    if missing:
        yield f"in {word}/agent.toml fill in {', '.join(missing)}"
    if not filled:
        yield f"in {word}/README.md say what it is in place of each TODO"
    yield f"hipg-bench submit check {word}"
    yield f"hipg-bench submit pack {word}"


@app.command()
def check(
    folder: Folder,
    trust: Trust = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON instead of a table.")] = False,
) -> None:
    """Check whether an agent can be submitted and print how to fix errors. Exits with 1 on errors."""
    from hipg_bench.submissions.check import check as look

    found: list[Finding] = []
    for finding in look(folder, trust=trust):
        found.append(finding)
        if not as_json:
            _print(finding)
    if as_json:
        console.show_json([dataclasses.asdict(finding) for finding in found])
    errors = sum(finding.severity == "error" for finding in found)
    if errors:
        if not as_json:
            console.say(f"\n{errors} error{'s' * (errors > 1)}: it cannot be packed yet")
        raise typer.Exit(1)
    if not as_json:
        console.say(f"\nready: hipg-bench submit pack {folder}")


@app.command()
def pack(
    folder: Folder,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            "-o",
            help="Output zip; by default <name>.zip here, or beside the folder if it is the working folder.",
        ),
    ] = None,
    trust: Trust = False,
) -> None:
    """Check an agent and pack it into a zip. Nothing is written if the check finds errors."""
    from hipg_bench.submissions.archive import pack as write
    from hipg_bench.submissions.check import check as look

    inside = Path.cwd().resolve().is_relative_to(folder.resolve())
    place = folder.resolve().parent if inside else Path()  # never into the folder that is packed
    target = out or place / f"{folder.resolve().name}.zip"
    outputs.check_free(target, outputs.ARCHIVE)
    findings = [finding for finding in look(folder, trust=trust) if finding.severity != "fine"]
    for finding in findings:
        _print(finding)
    if any(finding.severity == "error" for finding in findings):
        console.say("\nnot packed")
        raise typer.Exit(1)
    digest = write(folder, target)
    console.say(f"{target}: {target.stat().st_size} bytes, sha256 {digest}")


def _print(finding: Finding) -> None:
    from rich.text import Text

    line = Text.assemble(
        (f"{finding.severity:<7}", _STYLES[finding.severity]),
        (console.printable(finding.where), "bold"),
        ": ",
        console.printable(finding.what),
    )
    console.out.print(line, soft_wrap=True)
    if finding.remedy:
        console.say(f"        {finding.remedy}")
