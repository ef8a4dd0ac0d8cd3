"""Measuring what fixes a task's score, and what shows that the task is about health.

The measured numbers are frozen in the task file: anchors (random actions at score 0, the reference
at 1), the hazard sensitivity, and the scores of open-loop baselines, which must be low.
"""

from __future__ import annotations

import dataclasses
import math
import re
import tomllib
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from hipg_bench import registry
from hipg_bench.errors import SpecError
from hipg_bench.evaluation import splits
from hipg_bench.evaluation.episodes import EvaluationJob, Row
from hipg_bench.evaluation.statistics import mean_ci95
from hipg_bench.paths import write_text
from hipg_bench.policies.policy import Policy
from hipg_bench.policies.scripted import Scripted
from hipg_bench.policies.simple import Constant, Random, TimeOnly, Zero
from hipg_bench.spec import Anchor, Anchors, TaskSpec, parse

_SEED = 10_000
"""First evaluation seed of the measurements; scoring uses others."""
_CHOICE_SEED = 20_000
"""First evaluation seed of the worlds on which the best variant of a probe is chosen."""
_VARIANTS, _CHOICE_EPISODES = 16, 32
_RISK = "hazard_peak"
"""The family number that turns the hazard off at 0."""

Progress = Callable[[str, float], None]
"""Told what is measured, and how many more of its episodes are done."""


@dataclasses.dataclass(frozen=True)
class Calibration:
    """What was measured of a task.

    Attributes:
        spec: the task, with its new anchors and facts.
        scores: scores and their intervals on the new scale, for the printed table.
    """

    spec: TaskSpec
    scores: Mapping[str, tuple[float, tuple[float, float]]]


def has_hazard(spec: TaskSpec) -> bool:
    """Whether there is a hazard to turn off."""
    return spec.params.get(_RISK, 0.0) > 0 and spec.params.get("hazards", 1) > 0


def calibrate(spec: TaskSpec, episodes: int, *, threads: int = 0, progress: Progress) -> Calibration:
    """Measure a task.

    Args:
        spec: the task; its present anchors are not used.
        episodes: per measured policy.
        threads: physics threads.
        progress: told how far it is.

    Raises:
        UnknownNameError: its family has neither a scripted expert nor a stated reference.
    """
    lab = _Lab(spec, EvaluationJob(_SEED, episodes, threads=threads), progress)
    size = registry.definition_of(spec).layout.action.size
    random = lab.play("random", Random(size))
    reference, reference_is = _stated(spec) or (
        _anchor(lab.play("scripted", Scripted(spec))), "scripted expert with the joint state",
    )  # fmt: skip
    anchors = Anchors(random=_anchor(random), reference=reference, reference_is=reference_is)
    scale = spec.model_copy(update={"anchors": anchors})

    scores = {
        "zero": _score(scale, lab.play("zero", Zero(size))),
        "constant": _score(scale, lab.best("constant", lambda variant: Constant(size, variant))),
        "time_only": _score(scale, lab.best("time_only", lambda variant: TimeOnly(size, variant))),
    }
    facts = {f"score_{name}": score for name, (score, _) in scores.items()}
    facts["random_deaths"] = float(np.mean([row["deaths"] for row in random])) / spec.num_agents
    if has_hazard(spec):
        harmless = spec.override(**{_RISK: 0.0})
        # with nothing to fear, the expert is the one that fears nothing
        safe = lab.play("hazard off", Scripted(harmless, blind=True), harmless)
        blind = lab.play("hazard-unaware", Scripted(spec, blind=True))
        scores |= {"hazard off": _score(scale, safe), "hazard-unaware": _score(scale, blind)}
        facts["hazard_unaware_deaths"] = float(np.mean([row["deaths"] for row in blind])) / spec.num_agents
        facts["score_hazard_unaware"] = scores["hazard-unaware"][0]
        facts["score_hazard_off"] = scores["hazard off"][0]
        facts["hazard_sensitivity"] = scores["hazard off"][0] - scores["hazard-unaware"][0]
    rounded = {name: round(value, 4) for name, value in facts.items()}
    return Calibration(scale.model_copy(update={"calibration": rounded}), scores)


def anchors_in(split: str, spec: TaskSpec, episodes: int, *, threads: int = 0, progress: Progress) -> Anchors:
    """Measure a task's anchors under the rules of a split.

    The reference knows what the split changed: it is made again for each variant.

    Raises:
        UnknownNameError: no such split, or it has no rules for the task's family.
    """
    job = EvaluationJob(_SEED, episodes, threads=threads, split=split)
    size = registry.definition_of(spec).layout.action.size
    random = job.play_all(spec, Random(size), lambda done: progress("random", done))
    stated = _stated(spec)
    if stated:
        return Anchors(random=_anchor(random), reference=stated[0], reference_is=stated[1])
    rows: list[Row] = []
    for worlds in job.batches():
        expert = Scripted(job.spec(spec, worlds[0]))
        rows += job.play(spec, expert, worlds, lambda done: progress("scripted", done))
    return Anchors(random=_anchor(random), reference=_anchor(rows))


def write_anchors(split: str, task: str, anchors: Anchors) -> None:
    """Put a task's anchors in a split beside those of the other tasks."""
    known = {name: dict(tasks) for name, tasks in splits.anchors().items()}
    known.setdefault(split, {})[task] = anchors
    lines = ["# Measured by `hipg-bench calibrate TASK --split SPLIT --episodes 1280 --write`."]
    for name in sorted(known):
        for measured in sorted(known[name]):
            lines += ["", f'[{name}."{measured}"]', *_lines(known[name][measured])]
    write_text(splits.folder() / "anchors.toml", "\n".join(lines) + "\n")
    splits.anchors.cache_clear()


def write(spec: TaskSpec, path: Path) -> None:
    """Put a spec's anchors and facts into its task file; all other lines stay as they are.

    Raises:
        SpecError: the spec has no anchors, or the result would not be a valid task file.
    """
    if spec.anchors is None:
        raise SpecError(f"{spec.task}: nothing measured to write")
    lines = [
        _without(path.read_text(encoding="utf-8"), ("anchors", "calibration")),
        "[anchors]",
        *_lines(spec.anchors),
        "",
        "[calibration]",
        *(f"{name} = {value}" for name, value in spec.calibration.items()),
    ]
    text = "\n".join(lines) + "\n"
    parse(TaskSpec, tomllib.loads(text), str(path))
    write_text(path, text)


@dataclasses.dataclass(frozen=True)
class _Lab:
    """Where a task is measured."""

    spec: TaskSpec
    job: EvaluationJob
    progress: Progress

    def play(self, name: str, policy: Policy, spec: TaskSpec | None = None) -> list[Row]:
        return self.job.play_all(spec or self.spec, policy, lambda done: self.progress(name, done))

    def best(self, name: str, variant: Callable[[int], Policy]) -> list[Row]:
        """Episodes of the best of some variants of a probe, chosen on other worlds."""
        choice = EvaluationJob(_CHOICE_SEED, _CHOICE_EPISODES, threads=self.job.threads)
        # choosing counts as half of the work
        share = self.job.episodes / (2 * _CHOICE_EPISODES * _VARIANTS)
        means = [
            _mean(choice.play_all(self.spec, variant(k), lambda done: self.progress(name, share * done)))
            for k in range(_VARIANTS)
        ]
        chosen = variant(int(np.argmax(means)))
        return self.job.play_all(self.spec, chosen, lambda done: self.progress(name, done / 2))


def _stated(spec: TaskSpec) -> tuple[Anchor, str] | None:
    """The reference of multi-walker is a feat, not a policy: the plank carried at the rewarded top speed."""
    if "speed_cap" not in spec.params:
        return None
    seconds = spec.horizon * spec.control_step
    metres = spec.params["speed_cap"] * seconds
    worth = spec.weights["progress"] * metres
    return (
        Anchor(mean=worth, ci95=(worth, worth), episodes=0),
        f"the plank carried {metres:g} m in {seconds:g} s with all alive (stated, not measured)",
    )


def _anchor(rows: Sequence[Row]) -> Anchor:
    mean, interval = mean_ci95([_returns(rows)])
    return Anchor(
        mean=round(mean, 4), ci95=(round(interval[0], 4), round(interval[1], 4)), episodes=len(rows)
    )


def _lines(anchors: Anchors) -> list[str]:
    return [
        f"random = {_toml(anchors.random)}",
        f"reference = {_toml(anchors.reference)}",
        f'reference_is = "{anchors.reference_is}"',
    ]


def _toml(anchor: Anchor) -> str:
    low, high = anchor.ci95
    return f"{{ mean = {anchor.mean}, ci95 = [{low}, {high}], episodes = {anchor.episodes} }}"


def _score(scale: TaskSpec, rows: Sequence[Row]) -> tuple[float, tuple[float, float]]:
    mean, (low, high) = mean_ci95([_returns(rows)])
    return scale.score(mean), (scale.score(low), scale.score(high))


def _mean(rows: Sequence[Row]) -> float:
    return math.fsum(row["return"] for row in rows) / len(rows)


def _returns(rows: Sequence[Row]) -> np.ndarray:
    return np.array([row["return"] for row in rows])


def _without(text: str, sections: Sequence[str]) -> str:
    """Cut whole TOML sections (and their subsections) out of a text, and blank lines off its end."""
    kept: list[str] = []
    cutting = False
    for line in text.splitlines():
        header = re.match(r"\s*\[+\s*([A-Za-z0-9_-]+)", line)
        if header:
            cutting = header[1] in sections
        if not cutting:
            kept.append(line)
    return "\n".join(kept).rstrip() + "\n"
