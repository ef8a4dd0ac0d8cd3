"""Cards of bundles that training made: ``agent.toml`` once, ``README.md`` from what lies in the folder."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np

from hipg_bench.documents import read_json
from hipg_bench.policies.card import read_card

_SUMMARIES = {
    "min_health": "MAPPO with min-health crediting: each live agent is credited with what the team would "
    "lose without it",
    "central": "MAPPO with a central critic: all live agents share the team's advantage",
    "local": "MAPPO with a local critic: each agent's advantage is estimated from its own observation",
    "ma_poca": "MA-POCA: attention over the living; each agent's baseline leaves out its own action",
    "coma": "COMA for continuous actions: the value of an agent's action over its policy's mean",
    "difference_rewards": "MAPPO with difference rewards: the team's reward less that without the agent",
    "maddpg": "MADDPG: an actor and a central critic for every agent, learned from replayed steps",
    "qmix": "QMIX: values of discretised actions, mixed monotonically, learned from replayed steps",
}


def card_text(algorithm: str, name: str) -> str:
    """An ``agent.toml`` for an algorithm, perhaps with a label."""
    plain, _, label = algorithm.partition("-")
    summary = _SUMMARIES[plain] + (f"; variant {label}, see sweeps/" if label else "")
    return f'name = "{name}"\nsummary = "{summary}"\nkind = "network"\nlicense = "Apache-2.0"\n'


def readme(folder: Path) -> str:
    """The model card: a section per task, a row per training seed.

    Args:
        folder: a bundle with ``<task>/seed<k>.json``.
    """
    card = read_card(folder / "agent.toml")
    lines = [f"# {card.name}", "", f"{card.summary}.", "", _ABOUT]
    for task in sorted({path.parent.name for path in folder.glob("*/seed*.json")}):
        records = {
            int(path.stem.removeprefix("seed")): read_json(path)
            for path in (folder / task).glob("seed*.json")
            if re.fullmatch(r"seed\d+", path.stem)
        }
        lines += _section(task, dict(sorted(records.items())))
    return "\n".join(lines)


_ABOUT = """\
Written by `hipg-bench collect` from the records beside the weights. Scores are of the standard protocol: 0
as random actions, 1 as the task's reference, in brackets the 95 % interval over the episodes, which speaks of
the episodes' randomness, not of the training's. The last policy of a run counts, not the one that periodic
evaluations found best.
Curves: `<task>/seed<k>.curve.csv`.
"""


def _section(task: str, records: dict[int, dict[str, Any]]) -> list[str]:
    scores = [one["result"]["score"] for one in records.values() if "result" in one]
    mean = f"Mean score {np.mean(scores):.2f} over {len(scores)} training seeds. " if len(scores) > 1 else ""
    first = next(iter(records.values()))
    command = re.sub(r"--seed \d+", "--seed K", first["command"])
    command = re.sub(r"--out \S+", "--out DIR", command)
    command = re.sub(r'initial_policy="[^"]*"', f'initial_policy="{task}/seedK.initial.safetensors"', command)
    return [
        f"## {task}",
        f"{mean}Trained with `{command}`.",
        "",
        "| seed | environment steps | hours | score | return | survival | further | hardware |",
        "|---|---|---|---|---|---|---|---|",
        *(_row(seed, one) for seed, one in records.items()),
        "",
    ]


def _row(seed: int, record: dict[str, Any]) -> str:
    hardware = f"{record['machine']}, {record['threads']} thread{'s' if record['threads'] > 1 else ''}"
    cells = [str(seed), f"{record['env_steps']:,}", f"{record['seconds'] / 3600:.2f}"]
    result = record.get("result")
    if result is None:
        return _table_row([*cells, "not measured", "", "", "", hardware])
    score = "no anchors"
    if result["score"] is not None:
        low, high = result["score_ci95"]
        score = f"{result['score']:.3f} [{low:.3f}, {high:.3f}]"
    further = ", ".join(
        f"{name} {result['metrics'][name]:.2f}" for name in _SHOWN if name in result["metrics"]
    )
    numbers = [score, f"{result['return']:.2f}", f"{result['survival']:.2f}", further]
    return _table_row([*cells, *numbers, hardware])


_SHOWN = ("covered", "connected", "displacement", "carriers", "slip")
"""Metrics that say in a task's own terms how good a team is."""


def _table_row(cells: list[str]) -> str:
    return "| " + " | ".join(cells) + " |"
