"""`submit init`: a folder that `check` accepts once it is filled in and has weights."""

from __future__ import annotations

import json
import os
import re
import shutil
from collections.abc import Sequence
from pathlib import Path

import jinja2

from hipg_bench import registry
from hipg_bench.errors import BundleError
from hipg_bench.evaluation.seeds import SUITE
from hipg_bench.paths import replacing, write_text
from hipg_bench.policies.card import Training
from hipg_bench.policies.trained import POLICY, RECORD, Trained, find_agent, read_record
from hipg_bench.submissions.metadata_checks import SUITE_TAG, TODO

_TEMPLATES = Path(__file__).parent / "templates"
_NAME = re.compile(r"[a-z0-9][a-z0-9_]{0,63}")


def _toml(text: str) -> str:
    """A TOML string: JSON's, but for characters beyond the basic plane, which stand as they are, and DEL."""
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")


def init(
    folder: Path,
    tier: int,
    *,
    authors: str = "",
    license: str = "",
    summary: str = "",
    runs: Sequence[Path] = (),
) -> list[Path]:
    """Write the templates of a tier into a new folder, or make a bundle of training runs.

    Args:
        folder: its name is the agent's.
        tier: 0 for declared networks, 1 for ONNX graphs, 2 for Python.
        authors: for the card; what is not given is left to be filled in.
        license: the same.
        summary: the same; of runs it is made up where it is not given.
        runs: folders of training runs of `hipg-bench train`, whose policies, curves and records it gets; the
            tier is then 0.

    Returns:
        The files.

    Raises:
        BundleError: a name or tier that is not allowed, the folder is there already, or a run has no policy,
            another tier, or the task and seed of another one.
    """
    name = folder.name
    if not _NAME.fullmatch(name):
        near = re.sub(r"[^a-z0-9]+", "_", name.lower()).strip("_")
        raise BundleError(
            f"name {name!r}: lower case letters, digits and _ are allowed; did you mean {near!r}?"
        )
    if tier not in (0, 1, 2):
        raise BundleError(f"tier {tier}: 0 (declared networks), 1 (ONNX) and 2 (Python) are allowed")
    if os.path.lexists(folder):
        raise BundleError(f"{folder} is there already")
    if runs and tier != 0:
        raise BundleError(f"policies of training runs are of tier 0, got tier {tier}")
    trained = [_trained(run) for run in runs]
    made = [f"{agent.task}/seed{agent.seed}" for agent in trained]
    if len(set(made)) < len(made):
        raise BundleError(f"two of these runs have the same task and seed: {', '.join(sorted(made))}")
    made_up = f"Trained by hipg-bench train on {', '.join(sorted({str(agent.task) for agent in trained}))}"
    values = {
        "name": name, "tier": tier, "suite": SUITE, "tasks": registry.tagged(SUITE_TAG),
        "authors": authors or TODO, "license": license or TODO,
        "summary": summary or (made_up if trained else f"{TODO}: one sentence"),
        "training": _training(trained),
        "runs": [
            {"place": place, "record": read_record(agent.folder)}
            for place, agent in zip(made, trained, strict=True)
        ],
    }  # fmt: skip
    engine = jinja2.Environment(loader=jinja2.FileSystemLoader(_TEMPLATES), undefined=jinja2.StrictUndefined)
    engine.filters["toml"] = _toml
    names = ["agent.toml", "README.md", *(["agent.py"] if tier == 2 else [])]
    for file in names:
        write_text(folder / file, engine.get_template(f"{file}.j2").render(values) + "\n")
    files = [folder / file for file in names]
    for place, agent in zip(made, trained, strict=True):
        for ending, source in _ENDINGS.items():
            files.append(folder / f"{place}{ending}")
            with replacing(files[-1]) as temporary:
                shutil.copyfile(agent.folder / source, temporary)
    return files


_ENDINGS = {".json": RECORD, ".curve.csv": "curve.csv", ".safetensors": POLICY}
"""Of a training seed's files in a bundle, and the run's file that each is."""


def _trained(run: Path) -> Trained:
    agent = find_agent(run)
    if not isinstance(agent, Trained) or not (agent.folder / RECORD).is_file():
        raise BundleError(f"{run} is no folder of a training run: it holds no {RECORD}")
    return agent


def _training(trained: Sequence[Trained]) -> Training:
    """What the card says of how the weights came about: the longest of the runs."""
    every = [agent.card.training for agent in trained]
    longest = max(every, key=lambda one: one.env_steps or 0, default=Training(env_steps=0, hours=0.0))
    return longest.model_copy(update={"hours": round(longest.hours or 0.0, 3)})
