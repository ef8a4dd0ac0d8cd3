"""`submit check`: everything that would keep a bundle from the board, each with what to do about it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from hipg_bench import registry
from hipg_bench.errors import BundleError, SandboxError
from hipg_bench.policies.bundle import Agent, bundle_files
from hipg_bench.policies.card import read_card
from hipg_bench.sandbox import choice
from hipg_bench.submissions.findings import Finding, error, fine
from hipg_bench.submissions.metadata_checks import (
    SUITE_TAG,
    look_at_card,
    look_at_files,
    look_at_readme,
    look_at_tasks,
)
from hipg_bench.submissions.smoke import try_alone, try_task, try_weights


def check(folder: Path, *, trust: bool = False) -> Iterator[Finding]:
    """Look at a bundle, then let it play; findings come as they are found.

    Args:
        folder: the bundle's.
        trust: run its code without a sandbox.
    """
    if not (folder / "agent.toml").is_file():
        yield _without_card(folder)
        return
    try:
        card, files = read_card(folder / "agent.toml"), bundle_files(folder)
    except BundleError as trouble:
        reason = str(trouble).removeprefix(f"{folder / 'agent.toml'}: ")
        yield error("agent.toml", reason, "docs/guides/submit.md lists the fields of the card")
        return
    agent = Agent(card, folder, trust)
    yield from look_at_card(card)
    yield from look_at_readme(folder)
    yield from look_at_files(card, files)
    if card.tier is None:
        return
    try:
        yield from look_at_tasks(agent)
        missing = list(_look_at_module(agent))
        yield from missing or _play(agent)
    except BundleError as trouble:  # of a file's name or kind, wherever it was met first
        yield error(
            "files", str(trouble), "docs/guides/submit.md says where files lie and what they are called"
        )


def _without_card(folder: Path) -> Finding:
    if not folder.is_dir():
        return error(str(folder), "there is no such folder", "`hipg-bench submit init NAME` makes one")
    inside = sorted(path.parent for path in folder.glob("*/agent.toml"))
    remedy = (
        f"check {inside[0]} instead" if inside else "`hipg-bench submit init NAME` makes a folder with one"
    )
    return error("agent.toml", f"is not in {folder}", remedy)


def _look_at_module(agent: Agent) -> Iterator[Finding]:
    """Whether the file that the entry point names is there."""
    if agent.card.entry_point is None:
        return
    module = agent.card.entry_point.partition(":")[0].replace(".", "/")
    if not any((agent.folder / path).is_file() for path in (f"{module}.py", f"{module}/__init__.py")):
        yield error(
            "agent.toml: entry_point", f"there is no {module}.py in the folder",
            "entry_point = \"my_agent:make_agent\" is the function make_agent in my_agent.py",
        )  # fmt: skip


def _play(agent: Agent) -> Iterator[Finding]:
    """Play the first training of every task of the suite; the other trainings' files are looked at."""
    if agent.card.kind != "network":
        try:
            place = choice.NONE if agent.trust else choice.sandbox()
        except SandboxError as trouble:
            yield error("sandbox", str(trouble), "--trust checks without one, for code of your own")
            return
        yield fine("sandbox", f"it plays in: {place}")
    first = True
    for name in registry.tagged(SUITE_TAG):
        spec, seeds = registry.task_spec(name), agent.train_seeds(name)
        for train_seed in seeds[1:]:
            yield from try_weights(agent, spec, train_seed)
        played = list(try_task(agent, spec, seeds[0])) if seeds else []
        yield from played
        sound = played and all(finding.severity != "error" for finding in played)
        if sound and first and agent.card.kind == "python" and agent.card.execution == "decentralised":
            first = False
            yield from try_alone(agent, spec, seeds[0])
