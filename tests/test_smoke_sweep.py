"""From a sweep's file to figures, by the commands alone."""

import csv
import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from hipg_bench.cli import app

SWEEP = Path(__file__).parent.parent / "sweeps" / "smoke.toml"
TASK = "hazard_nav-4"


def call(*options: object) -> str:
    done = CliRunner().invoke(app, [str(option) for option in options], catch_exceptions=False)
    assert done.exit_code == 0, done.output
    return done.stdout


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("smoke")
    call("train", "--sweep", SWEEP, "--out", folder / "runs", "--workers", 1)
    return folder


def test_from_training_to_figures(folder: Path) -> None:
    assert "5 finished" in call("train", "--sweep", SWEEP, "--out", folder / "runs", "--status")
    for run in (folder / "runs" / TASK).glob("*/seed*"):
        rows = list(csv.DictReader((run / "curve.csv").open()))
        assert sum(bool(row["score"]) for row in rows) == int(rows[-1]["steps"]) // 800
    options = ["--sweep", SWEEP, "--runs", folder / "runs", "--agents", folder / "agents"]
    assert "5 runs collected" in call("collect", *options, "--episodes", 8)
    assert "5 were there" in call("collect", *options)
    bundles = {path.name for path in (folder / "agents").iterdir()}
    assert bundles == {"mappo_minhealth", "mappo_central", "qmix"}
    call("figures", "--agents", folder / "agents", "--out", folder / "figures")
    verdicts = json.loads((folder / "figures" / "verdicts.json").read_text())
    runs = {(one["claim"], one["suite"]): one["runs"] for one in verdicts}
    assert runs["min-health is above central", "standard"] == [2, 2]
    # two runs against two cannot decide anything: p is 1/3 at least
    assert {one["verdict"] for one in verdicts} == {"undecided", "too few runs"}
    audit = ["audit", "--agent", folder / "agents" / "mappo_central", "--task", TASK, "--json"]
    found = json.loads(call(*audit, "--worlds", 2, "--moments", 1, "--repeats", 2))
    assert found["cases"] <= 2 * 4
