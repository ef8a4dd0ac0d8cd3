"""The suite version: everything a score depends on, frozen in one file that a test compares with the tree.

``tasks/suites/<suite>.toml`` holds the tasks with their fingerprints and anchors in every split, the seeds,
the failure rule, the range of engine versions, and a hash of every file that decides how an episode goes.
Scores are comparable where these are the same. A change that is meant makes a new suite version; one that
changes no behaviour (the golden episodes say so) is frozen again under the same.
"""

from __future__ import annotations

import hashlib
import importlib.metadata
import json
import tomllib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from packaging.requirements import Requirement

from hipg_bench import registry
from hipg_bench.evaluation import sources, splits
from hipg_bench.evaluation.failures import failures_of_a_dnf
from hipg_bench.evaluation.results import SCHEMA
from hipg_bench.evaluation.seeds import FIRST_SEED, SUITE, WORLDS_PER_SEED
from hipg_bench.paths import data_folder, write_text
from hipg_bench.spec import Anchors

BLOCKS = 5
"""Evaluation seeds per task and training seed."""
EPISODES = BLOCKS * WORLDS_PER_SEED
"""Episodes per task and training seed."""
_ENGINE = ("mujoco", "numpy", "scipy")


def path_of(suite: str = SUITE) -> Path:
    """The file of a suite version."""
    return data_folder("tasks") / "suites" / f"{suite}.toml"


def facts() -> dict[str, dict[str, Any]]:
    """What the tree says now, in the form of the file."""
    return {
        "protocol": {
            "suite": SUITE,
            "schema": SCHEMA,
            "blocks": BLOCKS,
            "worlds_per_block": WORLDS_PER_SEED,
            "counted_episode": "the first of each world",
            "first_public_seed": FIRST_SEED,
            "hidden_seed": "first 63 bits of HMAC-SHA256(salt, 'suite|split|task|block')",
            "failures_of_a_dnf": failures_of_a_dnf(EPISODES),
            "splits": list(splits.SPLITS),
        },
        "engine": _engine(),
        **{f"tasks.{name}": _task(name) for name in registry.tagged("standard")},
        "files": dict(_files()),
    }


def frozen(suite: str = SUITE) -> dict[str, dict[str, Any]]:
    """What the file of a suite version says."""
    values = tomllib.loads(path_of(suite).read_text(encoding="utf-8"))
    tasks = {f"tasks.{name}": task for name, task in values.pop("tasks").items()}
    return {"protocol": values["protocol"], "engine": values["engine"], **tasks, "files": values["files"]}


def differences() -> list[str]:
    """Where the tree is not what was frozen: one line each, none if it is."""
    if not path_of().exists():
        return [f"{path_of()} is missing"]
    then, now = frozen(), facts()
    lines: list[str] = []
    for section in sorted(then.keys() | now.keys()):
        before, after = then.get(section, {}), now.get(section, {})
        lines += [
            f"{section}: {name} was {before.get(name)}, is {after.get(name)}"
            for name in sorted(before.keys() | after.keys())
            if before.get(name) != after.get(name)
        ]
    return lines


def identity() -> dict[str, Any]:
    """What a result says of the suite it was made with: its name, a hash, and whether the tree matches."""
    text = json.dumps(facts(), sort_keys=True)
    return {
        "suite": SUITE,
        "digest": hashlib.sha256(text.encode()).hexdigest()[:12],
        "frozen": not differences(),
    }


def freeze() -> Path:
    """Write what the tree says now; return the file."""
    lines = ["# Frozen by `hipg-bench suite freeze`; a test compares it with the tree. Not edited by hand."]
    for section, values in facts().items():
        kind, _, name = section.partition(".")
        lines += ["", f'[{kind}."{name}"]' if name else f"[{kind}]"]
        lines += [f"{_key(key)} = {json.dumps(value)}" for key, value in values.items()]
    path = path_of()
    write_text(path, "\n".join(lines) + "\n")
    return path


def _key(name: str) -> str:
    return name if name.isidentifier() else f'"{name}"'


def _engine() -> dict[str, str]:
    """Versions that are allowed, as the package declares them."""
    declared = map(Requirement, importlib.metadata.requires("hipg-bench") or [])
    ranges = {one.name: str(one.specifier) for one in declared if one.marker is None}
    return {name: ranges[name] for name in _ENGINE}


def _task(name: str) -> dict[str, Any]:
    """What is frozen of a task: random and reference returns stand for its anchors."""
    spec = registry.task_spec(name)
    scales = {split: splits.with_anchors(split, spec).anchors for split in splits.SPLITS}
    return {"version": spec.version, "fingerprint": spec.fingerprint, "floor": spec.floor, **_scales(scales)}


def _scales(scales: Mapping[str, Anchors | None]) -> dict[str, list[float]]:
    return {
        f"anchors_{split}": [anchors.random.mean, anchors.reference.mean] if anchors else []
        for split, anchors in scales.items()
    }


def _files() -> Iterator[tuple[str, str]]:
    """Every file that decides how an episode goes, with 16 hex digits of its SHA-256."""
    package = Path(__file__).resolve().parents[1]
    for path in sources.files():
        yield f"hipg_bench/{path.as_posix()}", _digest(package / path)
    assets, rules = data_folder("assets"), splits.folder()
    for path in sorted(assets.glob("*.xml")):
        yield f"assets/{path.name}", _digest(path)
    for path in sorted(rules.iterdir()):
        # what it holds of anchors stands with the tasks
        if path.suffix in (".toml", ".safetensors") and path.name != "anchors.toml":
            yield f"tasks/splits/{path.name}", _digest(path)


def _digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()[:16]
