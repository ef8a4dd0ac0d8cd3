"""The results as a page: the table of verdicts, what each algorithm reached, and the figures."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy import stats

from hipg_bench.comparison.artefacts import BUNDLES
from hipg_bench.comparison.claims import TASKS, Judged
from hipg_bench.comparison.figures import FAMILIES
from hipg_bench.comparison.traces import Trace
from hipg_bench.errors import HipgError
from hipg_bench.paths import write_text

BEGIN = "<!-- results: written by hipg-bench figures -->"
END = "<!-- end of results -->"
_CAPTIONS = {
    "paper": "The paper's six campaigns",
    "appendix": "Without a hazard: the paper's appendix",
    "standard": "Our suite's tasks with a hazard",
    "masking": "What masking the dead does",
}


def results(judged: Sequence[Judged], runs: Sequence[Trace], figures: Sequence[str]) -> str:
    """Everything that follows from the runs, in Markdown.

    Args:
        judged: the claims.
        runs: of which.
        figures: links to the drawn files.
    """
    parts = [
        "## Verdicts",
        verdict_table(judged),
        "### Task by task",
        task_table(judged),
        "## Final scores",
        score_table(runs),
        "## Curves",
    ]
    for family in FAMILIES:
        drawn = [link for link in figures if Path(link).stem in (family, f"{family}_iqm")]
        if drawn:
            parts += [f"### {_CAPTIONS[family]}", *(f"![{_CAPTIONS[family]}]({link})" for link in drawn)]
    return "\n\n".join(parts) + "\n"


def verdict_table(judged: Sequence[Judged]) -> str:
    """One row per claim and suite."""
    lines = [
        "| claim | suite | compared | runs | P(improvement) | 95 % interval | permutation p | verdict |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for one in judged:
        where = ", ".join(one.strata) or "nothing yet"
        if one.strata and one.missing:
            where += f" (too few runs: {', '.join(one.missing)})"
        numbers = ["", "", ""]
        if one.found is not None:
            low, high = one.found.ci95
            numbers = [f"{one.found.p:.2f}", f"{low:.2f} to {high:.2f}", f"{one.found.chance:.3f}"]
        cells = [one.claim, one.suite, where, f"{one.runs[0]} / {one.runs[1]}", *numbers, one.verdict]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def task_table(judged: Sequence[Judged]) -> str:
    """One row per claim and task that has runs of both sides; p-values corrected within a claim (Holm)."""
    lines = ["| claim | task | P(improvement) | 95 % interval | corrected p | verdict |", "|---" * 6 + "|"]
    for one in judged:
        for name, single in one.by_stratum.items():
            low, high = single.found.ci95
            numbers = [f"{single.found.p:.2f}", f"{low:.2f} to {high:.2f}", f"{single.found.chance:.3f}"]
            lines.append("| " + " | ".join([one.claim, name, *numbers, single.verdict]) + " |")
    return "\n".join(lines)


def score_table(runs: Sequence[Trace]) -> str:
    """Interquartile mean, worst and best of what the runs of every algorithm reached."""
    trained = {run.algorithm for run in runs}
    columns = [algorithm for algorithm in BUNDLES if algorithm in trained]
    lines = ["| task | " + " | ".join(columns) + " |", "|---" * (1 + len(columns)) + "|"]
    for task in TASKS:
        cells = [
            _cell([run.final for run in runs if (run.task, run.algorithm) == (task, algorithm)])
            for algorithm in columns
        ]
        lines.append(f"| {task} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def write_results(page: Path, text: str) -> None:
    """Put the results between the page's two marks; the rest of the page stays.

    Raises:
        HipgError: the page has no marks.
    """
    content = page.read_text(encoding="utf-8")
    before, begin, rest = content.partition(BEGIN)
    _, end, after = rest.partition(END)
    if not begin or not end:
        raise HipgError(f"{page} has no place for results: lines {BEGIN!r} and {END!r} are needed")
    write_text(page, f"{before}{BEGIN}\n\n{text}\n{END}{after}")


def facts(judged: Sequence[Judged]) -> list[dict[str, object]]:
    """The verdicts for scripts."""
    return [
        {
            "claim": one.claim,
            "suite": one.suite,
            "compared": list(one.strata),
            "too_few_runs": list(one.missing),
            "runs": list(one.runs),
            "p_improvement": None if one.found is None else one.found.p,
            "ci95": None if one.found is None else list(one.found.ci95),
            "permutation_p": None if one.found is None else one.found.chance,
            "verdict": one.verdict,
            "by_task": {
                name: {
                    "p_improvement": single.found.p,
                    "ci95": list(single.found.ci95),
                    "corrected_p": single.found.chance,
                    "verdict": single.verdict,
                }
                for name, single in one.by_stratum.items()
            },
        }
        for one in judged
    ]


def _cell(scores: list[float]) -> str:
    if not scores:
        return "no runs"
    middle = float(stats.trim_mean(np.array(scores), 0.25))
    if len(scores) == 1:
        return f"{middle:z.2f} (1 run)"
    return f"{middle:z.2f} ({min(scores):z.2f} to {max(scores):z.2f}, {len(scores)} runs)"
