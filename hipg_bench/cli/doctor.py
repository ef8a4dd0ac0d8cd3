"""``hipg-bench doctor``."""

from __future__ import annotations

from typing import Annotated

import typer

from hipg_bench.cli import console

_STYLE = {"ok": "green", "note": "dim", "warning": "yellow", "broken": "bold red"}


def doctor(
    as_json: Annotated[bool, typer.Option("--json", help="For scripts.")] = False,
) -> None:
    """Try what this suite needs; say how to mend what does not work. Exit code 1 if scoring cannot work."""
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
        mends = {
            finding.mend: finding.name for finding in findings if finding.mend and finding.level != "note"
        }
        if mends:
            console.say("\nTo mend it, run:")
            for mend, name in mends.items():
                console.say(f"  {mend}    # {name}")
        else:
            console.say("\nNothing is wrong.")
    if not clinic.healthy(findings):
        raise typer.Exit(1)
