"""``hipg-bench doctor``."""

from __future__ import annotations

from typing import Annotated

import typer

from hipg_bench.cli import console

_STYLE = {"ok": "green", "note": "dim", "warning": "yellow", "broken": "bold red"}


def doctor(
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON instead of a table.")] = False,
) -> None:
    """Check what works on this machine and how to fix what does not. Exits with 1 if scoring fails."""
    from rich.text import Text

    from hipg_bench.evaluation import doctor as clinic

    if as_json:
        findings = clinic.examine()
        console.show_json(clinic.as_json(findings))
    else:
        with console.err.status("looking, this takes some seconds"):
            findings = clinic.examine()
        rows = console.table("", "what", "found")
        for finding in findings:
            style = _STYLE[finding.level]
            rows.add_row(Text(finding.level, style), finding.name, finding.text)
        console.show(rows)
        fixes = {finding.fix: finding.name for finding in findings if finding.fix and finding.level != "note"}
        if fixes:
            console.say("\nTo fix it, run:")
            for fix, name in fixes.items():
                console.say(f"  {fix}    # {name}")
        else:
            console.say("\nNothing is wrong.")
    if not clinic.healthy(findings):
        raise typer.Exit(1)
