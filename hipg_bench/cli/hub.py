"""``hipg-bench hub``: agents to and from the Hugging Face Hub."""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path
from typing import Annotated

import typer

from hipg_bench.cli import console
from hipg_bench.cli.options import AgentArgument, quoted
from hipg_bench.errors import HipgError

app = typer.Typer(
    help="Upload an agent to the Hugging Face Hub, or download one (docs/guides/submit.md).",
    no_args_is_help=True,
)

Repo = Annotated[str, typer.Argument(help="Repository on the Hub, USER/NAME.", metavar="USER/NAME")]


@app.command()
def push(
    agent: AgentArgument,
    repo: Repo,
    evaluation: Annotated[
        Path | None,
        typer.Option(help="Folder that `evaluate` wrote for this agent: scores and video of the model card."),
    ] = None,
    video: Annotated[
        Path | None, typer.Option(help="Video of an episode (.mp4), by default one of the evaluation's.")
    ] = None,
    private: Annotated[bool, typer.Option("--private", help="Make a new repository private.")] = False,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Write the folder that would be uploaded, and upload nothing.")
    ] = False,
    out: Annotated[
        Path | None, typer.Option(help="Folder that --dry-run writes, by default runs/hub-NAME.")
    ] = None,
    yes: Annotated[bool, typer.Option("--yes", help="Upload without asking.")] = False,
) -> None:
    """Upload an agent with a model card, its scores and a video; asks before anything is uploaded."""
    from hipg_bench.policies.bundle import load_agent
    from hipg_bench.submissions import hub

    if not dry_run and out is not None:
        raise HipgError("--out belongs to --dry-run")
    if not (dry_run or yes or _is_interactive()):
        raise HipgError("nothing is uploaded without being asked for: give --yes, or look with --dry-run")
    folder = load_agent(agent).folder
    if evaluation is None:
        console.warn(
            f"without --evaluation the model card has no scores: hipg-bench evaluate --agent {quoted(agent)}"
        )
    if dry_run:
        target = out or Path("runs") / f"hub-{repo.rpartition('/')[2]}"
        hub.stage(folder, target, repo, evaluation=evaluation, video=video)
        _list(target)
        console.say(f"nothing was uploaded; this would be: {target}")
        return
    with tempfile.TemporaryDirectory(prefix="hipg-hub-") as temporary:
        target = Path(temporary) / "upload"
        hub.stage(folder, target, repo, evaluation=evaluation, video=video)
        _list(target)
        if not yes and not typer.confirm(f"Upload these files to {repo}?"):
            console.say("nothing was uploaded")
            raise typer.Exit(1)
        console.say(hub.push(target, repo, private=private))


@app.command()
def pull(
    repo: Repo,
    out: Annotated[Path | None, typer.Option(help="New folder, by default the agent's name.")] = None,
    revision: Annotated[str | None, typer.Option(help="Branch, tag or commit.")] = None,
) -> None:
    """Download an agent and check it; nothing is written if the check finds errors."""
    from hipg_bench.submissions import hub

    folder, commit = hub.pull(repo, out, revision=revision)
    console.say(f"{folder}: {repo} at commit {commit}")
    console.say(f"next: hipg-bench evaluate --agent {quoted(folder)}")


def _is_interactive() -> bool:
    """Whether somebody can be asked."""
    return sys.stdin.isatty()


def _list(folder: Path) -> None:
    rows = console.table("file", ">bytes")
    for path in sorted(folder.rglob("*")):
        if path.is_file():
            rows.add_row(str(path.relative_to(folder)), f"{path.stat().st_size:,}")
    console.show(rows)
