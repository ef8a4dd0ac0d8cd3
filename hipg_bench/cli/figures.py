"""``hipg-bench figures``."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Annotated

import typer

from hipg_bench.cli import console, outputs
from hipg_bench.errors import HipgError

_VERDICTS = "verdicts.json"


def figures(
    out: Annotated[Path, typer.Option(help="Output folder for figures and verdicts.json.")] = Path(
        "docs/comparison"
    ),
    agents: Annotated[
        Path, typer.Option(help="Folder of the agent bundles whose curves are compared.")
    ] = Path("agents"),
    page: Annotated[
        Path | None,
        typer.Option(help="Page whose section of results is rewritten, such as docs/comparison.md."),
    ] = None,
) -> None:
    """Draw the paper's figures from the bundles' learning curves and test its claims."""
    from hipg_bench.comparison import claims
    from hipg_bench.comparison import page as pages
    from hipg_bench.comparison.figures import draw_all, figure_names
    from hipg_bench.comparison.traces import traces
    from hipg_bench.paths import write_text

    runs = traces(agents)
    if not runs:
        raise HipgError(
            f"{agents} holds no learning curves of the comparison: run `hipg-bench collect` first"
        )
    if not outputs.is_ours(out / _VERDICTS, outputs.VERDICTS):
        for name in (_VERDICTS, *figure_names()):
            outputs.check_free(out / name, outputs.VERDICTS)
    judged = claims.judge_all(runs)
    files = draw_all(runs, out)
    write_text(out / _VERDICTS, json.dumps(pages.facts(judged), indent=2) + "\n")
    if page is not None:
        links = [os.path.relpath(path, page.parent) for path in files]
        pages.write_results(page, pages.results(judged, runs, links))
    rows = console.table("claim", "suite", ">runs", ">P", "95 %", ">p", "verdict")
    for one in judged:
        found = one.found
        rows.add_row(
            one.claim,
            one.suite,
            f"{one.runs[0]}/{one.runs[1]}",
            console.number(found and found.p),
            console.interval(found and found.ci95),
            console.number(found and found.chance, 3),
            one.verdict,
        )
    console.show(rows)
    console.say(f"{len(runs)} runs; {', '.join(str(path) for path in files)}")
