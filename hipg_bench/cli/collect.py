"""``hipg-bench collect``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from hipg_bench.cli import console


def collect(
    sweep: Annotated[Path, typer.Option(help="The sweep file.")],
    runs: Annotated[Path, typer.Option(help="Folder of the sweep's runs, the --out of train.")],
    agents: Annotated[Path, typer.Option(help="Folder of agent bundles that the runs are added to.")] = Path(
        "agents"
    ),
    replace: Annotated[
        bool, typer.Option("--replace", help="Overwrite existing weights of the same seed.")
    ] = False,
    episodes: Annotated[int, typer.Option(min=1, help="Episodes per score.")] = 320,
) -> None:
    """Make agent bundles from a sweep's finished runs: weights, records, curves, scores and cards."""
    from collections import Counter

    from hipg_bench.comparison import artefacts
    from hipg_bench.evaluation.episodes import EvaluationJob
    from hipg_bench.learning.sweep import load

    found = load(sweep, runs)
    states: Counter[str] = Counter()
    with console.progress() as bars:
        bar = bars.add_task("collecting", total=len(found))
        for one in artefacts.collect(found, agents, replace=replace, job=EvaluationJob(episodes=episodes)):
            bars.advance(bar)
            states[one.state] += 1
            if one.state in _TOLD:
                name = f"{one.bundle}/{one.run.settings.task}/seed{one.run.settings.seed}"
                console.say(f"{name}: {_TOLD[one.state].format(run=one.run.out)}")
    console.say(
        f"{states['new']} runs collected into {agents}; {states['there']} were there, "
        f"{states['unfinished']} are unfinished"
    )


_TOLD = {
    "new": "from {run}",
    "kept": "other weights are there; --replace puts those of {run} in their place",
    "stale": "{run} is of another version of the task: train again",
}
