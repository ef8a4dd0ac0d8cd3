"""The site's page of one task, from its spec, layout, calibration, scores and learning curves."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import family_text
import plots
from tables import table

from hipg_bench.comparison.figures import band_of, styles_of
from hipg_bench.comparison.traces import Trace
from hipg_bench.documents import read_json
from hipg_bench.evaluation.splits import SPLITS
from hipg_bench.families.family import Definition
from hipg_bench.layout import Layout
from hipg_bench.registry import definition_of
from hipg_bench.spec import TaskSpec

ROOT = Path(__file__).parents[2]
_CALIBRATION = {
    "score_zero": "score of no action at all (`zero`)",
    "score_constant": "score of the best constant action",
    "score_time_only": "score of the best fixed sequence of actions",
    "random_deaths": "deaths per agent under random actions",
    "hazard_unaware_deaths": "deaths per agent of the hazard-unaware expert",
    "score_hazard_unaware": "score of the hazard-unaware expert",
    "score_hazard_off": "score of the same expert where the hazard cannot kill",
    "hazard_sensitivity": "**hazard sensitivity**: the difference of the last two",
}
_AXES = {"observation": "Observation of one agent", "action": "Action of one agent", "state": "Joint state"}


def page(spec: TaskSpec, runs: Sequence[Trace]) -> str:
    """The page as Markdown.

    Args:
        spec: the task.
        runs: all published training runs, of this task and of others.
    """
    definition = definition_of(spec)
    own = [run for run in runs if run.task == spec.task]
    parts = [
        f"# {spec.task}\n\n{spec.summary}.\n",
        _film(spec.task),
        _facts(definition),
        _rules(definition),
        _numbers(definition),
        _scale(spec),
        *(_vector(name, getattr(definition.layout, name)) for name in _AXES),
        _metrics(definition),
        _scores(spec.task, own),
        _curves(spec.task, own),
        _commands(spec.task),
    ]
    return "\n".join(part for part in parts if part)


def _film(task: str) -> str:
    if not (ROOT / "docs" / "films" / f"{task}.webp").exists():
        return ""
    return f'![{task}, one episode](../films/{task}.webp){{ width="800" .film }}\n'


def _facts(definition: Definition) -> str:
    spec, layout = definition.spec, definition.layout
    seconds = spec.horizon * spec.control_step
    facts = [
        ("family", f"`{spec.family}`"),
        ("agents N", spec.num_agents),
        ("horizon T", f"{spec.horizon} control steps of {spec.control_step:g} s: {seconds:g} s"),
        ("observation O, action A", f"{layout.observation.size} and {layout.action.size} numbers per agent"),
        ("joint state S", f"{layout.state.size} numbers"),
        ("version, fingerprint", f"{spec.version}, `{spec.fingerprint}`"),
        ("suites", ", ".join(spec.tags) or "-"),
    ]
    return table(("", ""), facts)


def _rules(definition: Definition) -> str:
    rules = family_text.rules(definition.family)
    lines = [f"**{heading}.** {text}\n" for heading, text in rules.items()]
    if definition.spec.family == "multiwalker" and definition.params.planar:
        lines.append("Walkers and plank move in the sagittal plane only.\n")
    if definition.spec.family in ("hazard_nav", "paper_nav") and not definition.params.hazards:
        lines.append("This task has no hazard: it is the control, in which nobody dies of where it flies.\n")
    if definition.spec.family.startswith("paper_"):
        lines.append(
            "Units, laws and known differences from the authors' code: [the paper suite](paper_suite.md).\n"
        )
    return "\n".join(["## Rules\n", *lines])


def _numbers(definition: Definition) -> str:
    spec, meanings = definition.spec, family_text.param_meanings(definition.family)
    terms = family_text.field_meanings(definition.family.Terms)
    params = [(f"`{name}`", _number(value), meanings[name]) for name, value in spec.params.items()]
    weights = [(f"`{name}`", _number(value), terms[name]) for name, value in spec.weights.items()]
    return "\n".join([
        "## Numbers\n",
        "Each of them can be changed: `hipg_bench.make(task, name=value)`, `--set name=value`. "
        "A task so changed has no scores until `hipg-bench calibrate` has measured it. "
        f"`tasks/{spec.task}.toml` has them all.\n",
        table(("name", ">value", "meaning"), params),
        "The reward of a step is the sum of these terms, each times its weight:\n",
        table(("term", ">weight", "meaning"), weights),
    ])  # fmt: skip


def _scale(spec: TaskSpec) -> str:
    if spec.anchors is None:
        return ""
    anchors = spec.anchors
    rows = [
        (name, score, f"{one.mean:.2f}", _interval(one.ci95) if one.episodes else "stated")
        for name, score, one in (
            ("random actions", 0, anchors.random), (anchors.reference_is, 1, anchors.reference),
        )
    ]  # fmt: skip
    facts = [
        (text, f"{spec.calibration[name]:.2f}")
        for name, text in _CALIBRATION.items()
        if name in spec.calibration
    ]
    return "\n".join([
        "## Scale of the score\n",
        table(("", ">score", ">mean return", ">95 % interval"), rows),
        f"`hipg-bench calibrate {spec.task}` measures these again, each over "
        f"{anchors.random.episodes:,} episodes:\n",
        table(("", ">"), facts),
    ])  # fmt: skip


def _vector(name: str, vector: Layout) -> str:
    rows = []
    for block in vector.present:
        columns = vector.slices[block.name]
        last = columns.stop - 1
        span = f"{columns.start} to {last}" if last > columns.start else f"{last}"
        shape = " x ".join(map(str, block.shape))
        rows.append((f"`{block.name}`", span, shape, block.unit, block.frame, block.visible))
    return "\n".join([
        f"## {_AXES[name]}\n",
        f"{vector.size} numbers. At times when a block holds nothing, its entries are 0.\n",
        table(("block", ">columns", ">shape", "unit", "frame", "visible"), rows),
    ])  # fmt: skip


def _metrics(definition: Definition) -> str:
    meanings = family_text.field_meanings(definition.family.Metrics)
    rows = [(f"`{name}`", meanings[name]) for name in definition.metrics]
    return "## Metrics of an episode\n\nBeside return, length, survival and deaths:\n\n" + table(
        ("name", ""), rows
    )


def _scores(task: str, runs: Sequence[Trace]) -> str:
    parts = ["## Scores\n"]
    rows = _entries(task)
    if rows:
        parts += [
            "Entries of the leaderboard by split, with 95 % intervals over the 320 episodes of one "
            "policy; they do not cover the randomness of training.\n",
            table(("agent", *(f">{name}" for name in SPLITS), ">survival"), rows),
        ]
    if runs:
        algorithms = list(dict.fromkeys(run.algorithm for run in runs))
        parts += [
            "Published training runs: mean score of the last policies over seeds (standard split), and "
            "the range of the runs where there are several. `hipg-bench agents` lists their bundles.\n",
            table(("algorithm", ">runs", ">score"), [_trained(runs, algorithm) for algorithm in algorithms]),
        ]
    return "\n".join(parts) if rows or runs else ""


def _entries(task: str) -> list[tuple[str, ...]]:
    rows = []
    for folder in sorted((ROOT / "leaderboard" / "entries").iterdir()):
        cells, survival = [], "-"
        for split in SPLITS:
            found = {one["task"]: one for one in read_json(folder / split / "results.json")["tasks"]}
            one = found.get(task)
            cells.append("-" if one is None else f"{one['score']:.2f} {_interval(one['score_ci95'])}")
            if one is not None and split == "standard":
                survival = f"{one['survival']:.0%}"
        if set(cells) != {"-"}:
            rows.append((f"`{folder.name}`", *cells, survival))
    return rows


def _trained(runs: Sequence[Trace], algorithm: str) -> tuple[str, str, str]:
    finals = [run.final for run in runs if run.algorithm == algorithm]
    name, *_ = styles_of([algorithm])[algorithm]
    spread = f" ({min(finals):.2f} to {max(finals):.2f})" if len(finals) > 1 else ""
    return name, str(len(finals)), f"{sum(finals) / len(finals):.2f}{spread}"


def _curves(task: str, runs: Sequence[Trace]) -> str:
    if not runs:
        return ""
    drawn = plots.figure(7.2, 3.6)
    axes = drawn.subplots()
    algorithms = list(dict.fromkeys(run.algorithm for run in runs))
    for algorithm, (name, colour, marker) in styles_of(algorithms).items():
        own = [run for run in runs if run.algorithm == algorithm]
        steps, middle, low, high = band_of(own, "range")
        axes.fill_between(steps / 1e6, low, high, color=colour, alpha=0.18, linewidth=0)
        count = f"{len(own)} run{'s' if len(own) > 1 else ''}"
        axes.plot(
            steps / 1e6, middle, color=colour, linewidth=1.8,
            marker=marker, markevery=max(1, len(steps) // 8), markersize=5, label=f"{name}, {count}",
        )  # fmt: skip
    axes.axhline(0, color=plots.PALE, linewidth=0.8, linestyle=":")
    axes.axhline(1, color=plots.PALE, linewidth=0.8, linestyle=":")
    axes.spines[["top", "right"]].set_visible(False)
    axes.set_xlim(left=0)
    axes.set_xlabel("environment steps, millions")
    axes.set_ylabel("score")
    axes.legend(frameon=False, labelcolor=plots.INK, fontsize=9, loc="center left", bbox_to_anchor=(1, 0.5))
    evaluated = all(run.evaluated for run in runs)
    what = (
        "Scores of periodic evaluations without exploration noise"
        if evaluated
        else "Scores of the training's own episodes, with exploration noise"
    )
    return "\n".join([
        "## Learning curves\n",
        f"{what}: the mean over runs, and the range where there are several. Dotted: random actions (0) and "
        "the reference (1).\n",
        plots.to_svg(drawn, f"learning curves on {task}"),
    ])  # fmt: skip


def _commands(task: str) -> str:
    return "\n".join([
        "## Commands\n",
        "```sh",
        f"hipg-bench tasks show {task}                    # these tables on the command line",
        f"hipg-bench train --task {task}",
        f"hipg-bench evaluate --agent scripted --tasks {task}",
        f"hipg-bench video --agent scripted --task {task} --out film.mp4",
        "```",
        "",
    ])  # fmt: skip


def _number(value: object) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value).lower()


def _interval(ends: Sequence[float]) -> str:
    return f"[{ends[0]:.2f}, {ends[1]:.2f}]"
