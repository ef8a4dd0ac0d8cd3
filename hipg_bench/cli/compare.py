"""``hipg-bench compare``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from hipg_bench.cli import console


def compare(
    folders: Annotated[list[Path], typer.Argument(help="What `evaluate` wrote, of one suite and split.")],
) -> None:
    """Rank evaluations, and compare the first of them with each other one in the same worlds."""
    from hipg_bench.evaluation import comparing, ranking

    names = {f"{folder}": comparing.read(folder) for folder in folders}
    table = console.table("place", "evaluation", "kind", ">score (IQM)", "")
    for one in ranking.rank(names):
        place = "-" if one.place is None else str(one.place)
        table.add_row(place, one.name, one.kind, console.number(one.score), console.interval(one.ci95))
    console.show(table)
    for other in folders[1:]:
        chance, ends = ranking.better(names[f"{folders[0]}"], names[f"{other}"])
        console.say(f"\n{folders[0]} against {other}")
        console.say(f"P(improvement) {chance:.2f} {console.interval(ends)}")
        rows = console.table("task", ">difference of scores", "")
        for task, (difference, interval) in comparing.differences(folders[0], other).items():
            rows.add_row(task, f"{difference:+.3f}", console.interval(interval, 3))
        console.show(rows)
