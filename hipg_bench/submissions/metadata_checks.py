"""What can be seen without playing: the card, the model card, the files and which tasks they are for."""

from __future__ import annotations

import csv
import json
import re
from collections.abc import Iterator, Mapping
from pathlib import Path, PurePosixPath

from hipg_bench import registry
from hipg_bench.errors import BundleError, hint
from hipg_bench.evaluation.seeds import SUITE
from hipg_bench.evaluation.statistics import METHOD_RUNS, MOST_RUNS
from hipg_bench.policies.bundle import Agent
from hipg_bench.policies.card import Card
from hipg_bench.submissions.archive import check_name, check_sizes
from hipg_bench.submissions.findings import Finding, advice, error, fine

SUITE_TAG = "standard"
"""Tag of the tasks of the suite that is submitted to."""
TODO = "TODO"
"""What the templates of `init` leave to be filled in."""
_LICENSES = "MIT, Apache-2.0, BSD-3-Clause, GPL-3.0-only, CC-BY-4.0, CC0-1.0"
_WEIGHTS = {".safetensors": "network", ".onnx": "onnx"}
_PLACE = re.compile(r"[^/]+/seed\d+(\.safetensors|\.onnx|\.json|\.curve\.csv)")
_LONGEST_README = 100_000
_SHORTEST_README = 200


def look_at_card(card: Card) -> Iterator[Finding]:
    """The fields that a submission needs beyond those that every bundle has."""
    if card.tier is None:
        yield error(
            "agent.toml: builtin",
            "policies that come with the package cannot be submitted",
            'say what your files are: kind = "network" (tier 0), "onnx" (tier 1) or "python" (tier 2)',
        )
    if card.suite != SUITE:
        yield error("agent.toml: suite", f"there is no suite {card.suite!r}", f'suite = "{SUITE}"')
    needed = {
        "authors": (card.authors, 'authors = "Ada Lovelace, Charles Babbage"'),
        "license": (card.license, f'license = "MIT", or what else others may do: {_LICENSES}, ...'),
        "summary": (card.summary, 'one sentence, such as summary = "PPO with shared weights"'),
    }
    for name, (value, remedy) in needed.items():
        if not value.strip() or TODO in value:
            yield error(
                f"agent.toml: {name}", "is missing" if not value.strip() else "is to be filled in", remedy
            )
    if card.license and not re.fullmatch(r"[A-Za-z0-9.+-]+( (OR|AND|WITH) [A-Za-z0-9.+-]+)*", card.license):
        yield advice(
            "agent.toml: license",
            f"{card.license!r} is no SPDX identifier",
            f"such as {_LICENSES}: spdx.org/licenses",
        )
    if TODO in card.link:
        yield error(
            "agent.toml: link", "is to be filled in", 'the address of the code or paper, or link = ""'
        )
    training = card.training
    asked = {"env_steps": training.env_steps, "framework": training.framework, "hardware": training.hardware}
    silent = [name for name, value in asked.items() if not value]
    if silent:
        yield advice(
            "agent.toml: training", f"{', '.join(silent)} not given",
            "readers compare by them: env_steps = 2_000_000 (control steps per training, all worlds), "
            'framework = "Stable-Baselines3 2.7, PPO", hardware = "8 CPU cores"',
        )  # fmt: skip
    yield fine("agent.toml", f"{card.name}, kind {card.kind!r} (tier {card.tier}), {card.execution}")


def look_at_readme(folder: Path) -> Iterator[Finding]:
    """The model card."""
    path = folder / "README.md"
    if not path.is_file():
        yield error(
            "README.md",
            "is missing",
            "a page on what the agent is and how it was trained; it is shown as text",
        )
        return
    text = path.read_text(encoding="utf-8", errors="replace")
    if TODO in text:
        yield error("README.md", f"still says {TODO}", "fill it in or delete the line")
    if len(text) > _LONGEST_README:
        yield error(
            "README.md", f"has {len(text)} characters", f"at most {_LONGEST_README} are shown: shorten it"
        )
    elif len(text) < _SHORTEST_README:
        yield advice(
            "README.md", f"has {len(text)} characters", "say how it was trained, and what it cannot do"
        )


def look_at_files(card: Card, files: Mapping[str, Path]) -> Iterator[Finding]:
    """Names, sizes, kinds and places."""
    try:
        check_sizes({name: path.stat().st_size for name, path in files.items()})
    except BundleError as trouble:
        yield error("files", str(trouble), "leave out what is not needed to act")
    for name, path in files.items():
        try:
            check_name(name)
        except BundleError as trouble:
            yield error(name, str(trouble), "rename, convert or remove it")
            continue
        suffix = PurePosixPath(name).suffix
        if suffix == ".py" and card.kind != "python":
            yield advice(
                name,
                f"is never run, as the kind is {card.kind!r}",
                "remove it, or give its link in agent.toml",
            )
        if suffix in _WEIGHTS and card.kind != "python":
            yield from _look_at_place(card, name)
        if _PLACE.fullmatch(name) and suffix in (".json", ".csv"):
            yield from _look_at_record(name, path)


def _look_at_place(card: Card, name: str) -> Iterator[Finding]:
    """Whether weights lie where they are looked for."""
    suffix = PurePosixPath(name).suffix
    if _WEIGHTS[suffix] != card.kind:
        yield error(name, f"is not looked at, as the kind is {card.kind!r}", f'kind = "{_WEIGHTS[suffix]}"')
    if not _PLACE.fullmatch(name):
        numbers = re.findall(r"\d+", PurePosixPath(name).stem) or ["0"]
        task = PurePosixPath(name).parent.name or "<task>"
        yield error(
            name, "is not looked at: it must be <task>/seed<k>" + suffix,
            f"rename it to {task}/seed{int(numbers[-1])}{suffix}, where the number is the training seed",
        )  # fmt: skip


def _look_at_record(name: str, path: Path) -> Iterator[Finding]:
    """What lies beside weights: the record of a training, and its learning curve."""
    try:
        text = path.read_text(encoding="utf-8")
        if name.endswith(".json"):
            json.loads(text)
            return
        columns = next(csv.reader(text.splitlines()), [])
    except (ValueError, RecursionError, csv.Error) as trouble:
        yield error(name, f"cannot be read: {trouble}", "rewrite or remove it")
        return
    missing = [
        " or ".join(names) for names in (("steps",), ("eval_return", "return")) if not {*names} & {*columns}
    ]
    if missing:
        yield error(
            name, f"has no column {', '.join(missing)}",
            "a learning curve has a row per evaluation with the columns steps (control steps) and return",
        )  # fmt: skip


def look_at_tasks(agent: Agent) -> Iterator[Finding]:
    """Which tasks it plays, and how many trainings of each there are."""
    known, suite = registry.tasks(), registry.tagged(SUITE_TAG)
    ending = {"network": ".safetensors", "onnx": ".onnx"}.get(agent.card.kind, "")
    seeds = {task: agent.train_seeds(task) for task in agent.tasks}
    for task in seeds.keys() - known.keys():
        where = f"agent.toml: tasks.{task}" if agent.card.kind == "python" else f"{task}/"
        yield error(
            where, f"there is no task {task!r}{hint(task, known)}", "name it as in `hipg-bench tasks`"
        )
    played = [task for task in suite if seeds.get(task)]
    missing = [task for task in suite if task not in played]
    lies = f"{(missing or suite)[0]}/seed0{ending}" if ending else '"hazard_nav-4" = [0] under [tasks]'
    if not played:
        remedy = f"train on one of {', '.join(suite)}, and add such as {lies}"
        yield error("tasks", f"it plays no task of the suite {SUITE}", remedy)
        return
    if missing:
        yield advice(
            "tasks", f"no policy for {', '.join(missing)}: each counts as 0 in the suite's score, as random",
            f"train on them too, and add such as {lies}",
        )  # fmt: skip
    for task in played:
        if len(seeds[task]) > MOST_RUNS:
            yield error(
                "tasks", f"{task} has {len(seeds[task])} training seeds; at most {MOST_RUNS} are allowed",
                "keep the first ones, chosen before their scores were known",
            )  # fmt: skip
        try:
            agent.check_distinct(task)
        except BundleError as trouble:
            yield error(task, str(trouble), "train each seed from the start, or keep one of the files")
    fewest = min(len(seeds[task]) for task in played)
    if fewest < METHOD_RUNS:
        yield advice(
            "tasks", f"{fewest} trained seed{'s' * (fewest > 1)} per task: it is shown as a checkpoint",
            f"train {METHOD_RUNS} or more from the start with other seeds to be ranked as a method",
        )  # fmt: skip
    listed = ", ".join(f"{task} ({len(seeds[task])})" for task in played)
    yield fine("tasks", f"plays {len(played)} of {len(suite)} tasks (trained seeds): {listed}")
