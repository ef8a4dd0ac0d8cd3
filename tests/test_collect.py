"""Finished runs become bundles: the run's own files, nothing lost, nothing overwritten unasked."""

import csv
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from hipg_bench.cli import app
from hipg_bench.comparison import artefacts
from hipg_bench.comparison.cards import readme
from hipg_bench.errors import BundleError
from hipg_bench.evaluation.episodes import EvaluationJob
from hipg_bench.learning import audit, sweep
from hipg_bench.learning.run import train
from hipg_bench.policies.bundle import load_agent
from hipg_bench.policies.network import load_network
from hipg_bench.registry import task_spec

SWEEP = """
[[run]]
tasks = ["coop_nav-3"]
algorithms = ["min_health"]
seeds = [0, 1, 2]
settings = { num_envs = 4, rollout = 5, steps = 40, actor_hidden = [8], critic_hidden = [8] }
[[run]]
tasks = ["coop_nav-3"]
algorithms = ["central"]
label = "masked"
settings = { num_envs = 4, rollout = 5, steps = 20, actor_hidden = [8], critic_hidden = [8] }
"""
TASK = "coop_nav-3"
FEW = EvaluationJob(episodes=8, threads=1)


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """Three finished runs; the one with seed 2 is half done."""
    folder = tmp_path_factory.mktemp("sweep")
    (folder / "sweep.toml").write_text(SWEEP)
    runs = sweep.load(folder / "sweep.toml", folder / "runs")
    for run in runs:
        half = run.settings.model_copy(update={"steps": 20})
        train(half if run.settings.seed == 2 else run.settings, run.out, command=run.command)
    return folder


def load(trained):
    return sweep.load(trained / "sweep.toml", trained / "runs")


@pytest.fixture(scope="module")
def agents(trained, tmp_path_factory):
    folder = tmp_path_factory.mktemp("agents")
    states = {
        (one.bundle, one.run.settings.seed): one.state
        for one in artefacts.collect(load(trained), folder, job=FEW)
    }
    assert states == {
        ("mappo_minhealth", 0): "new",
        ("mappo_minhealth", 1): "new",
        ("mappo_minhealth", 2): "unfinished",
        ("mappo_central_masked", 0): "new",
    }
    return folder


def test_a_bundle_holds_the_runs_own_files(trained, agents: Path) -> None:
    run, place = trained / "runs" / TASK / "min_health", agents / "mappo_minhealth" / TASK
    assert {path.name for path in place.iterdir()} == {
        "seed0.safetensors", "seed0.json", "seed0.curve.csv", "seed0.learner.safetensors",
        "seed1.safetensors", "seed1.json", "seed1.curve.csv",
    }  # fmt: skip
    for seed in (0, 1):
        assert (place / f"seed{seed}.safetensors").read_bytes() == (
            run / f"seed{seed}" / "policy.safetensors"
        ).read_bytes()
        assert (place / f"seed{seed}.curve.csv").read_text() == (
            run / f"seed{seed}" / "curve.csv"
        ).read_text()
        record = json.loads((place / f"seed{seed}.json").read_text())
        own = json.loads((run / f"seed{seed}" / "train.json").read_text())
        assert own.items() <= record.items()
        assert record["train_seed"] == seed
    agent = load_agent(agents / "mappo_minhealth")
    assert agent.train_seeds(TASK) == (0, 1)
    agent.policy(task_spec(TASK), 1)
    assert audit.load(place / "seed0.learner.safetensors")[2].task == TASK
    masked = load_agent(agents / "mappo_central_masked")
    assert "variant masked" in masked.summary


def test_the_score_is_of_the_standard_worlds(trained, agents: Path) -> None:
    """Against rows played here: the first eight worlds of the protocol, the last policy of the run."""
    policy = load_network(trained / "runs" / TASK / "min_health" / "seed1" / "policy.safetensors")
    rows = FEW.play_all(task_spec(TASK), policy)
    got = json.loads((agents / "mappo_minhealth" / TASK / "seed1.json").read_text())["result"]
    assert got["episodes"] == 8
    assert got["score"] == pytest.approx(np.mean([row["score"] for row in rows]))
    assert got["return"] == pytest.approx(np.mean([row["return"] for row in rows]))
    assert got["score_ci95"][0] < got["score"] < got["score_ci95"][1]
    assert got["metrics"]["covered"] == pytest.approx(np.mean([row["metrics"]["covered"] for row in rows]))
    card = (agents / "mappo_minhealth" / "README.md").read_text()
    assert f"## {TASK}" in card
    assert f"| 1 | 40 | 0.00 | {got['score']:.3f} [" in card
    assert "--algorithm min_health --preset recommended --seed K" in card


def test_nothing_is_overwritten_unasked(trained, agents: Path, tmp_path: Path) -> None:
    shutil.copytree(agents, tmp_path / "agents")
    weights = tmp_path / "agents" / "mappo_minhealth" / TASK / "seed0.safetensors"
    other = (weights.parent / "seed1.safetensors").read_bytes()
    weights.write_bytes(other)
    runs = load(trained)[:2]

    def states(**options):
        return [one.state for one in artefacts.collect(runs, tmp_path / "agents", job=FEW, **options)]

    assert states() == ["kept", "there"]
    assert weights.read_bytes() == other
    assert states(replace=True) == ["new", "there"]
    assert weights.read_bytes() == (runs[0].out / "policy.safetensors").read_bytes()
    record = json.loads((runs[0].out / "train.json").read_text())
    (runs[0].out / "train.json").write_text(json.dumps({**record, "task_fingerprint": "0" * 12}))
    try:
        assert states() == ["stale", "there"]
    finally:
        (runs[0].out / "train.json").write_text(json.dumps(record))


def test_a_collection_cut_short_is_no_bundle(trained, tmp_path: Path, monkeypatch) -> None:
    """The policy is written last: what was killed before has none, and is collected again."""
    runs = load(trained)[:1]
    copy = artefacts._copy
    with monkeypatch.context() as patch:
        patch.setattr(artefacts, "_copy", lambda source, target: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            list(artefacts.collect(runs, tmp_path, job=FEW))
    assert load_agent(tmp_path / "mappo_minhealth").tasks == ()
    assert artefacts._copy is copy
    assert [one.state for one in artefacts.collect(runs, tmp_path, job=FEW)] == ["new"]
    assert load_agent(tmp_path / "mappo_minhealth").tasks == (TASK,)


def test_a_long_curve_keeps_what_was_tried_and_its_ends() -> None:
    rows = [{"iteration": str(k), "score": "0.5" if k % 10 == 9 else ""} for k in range(1000)]
    kept = artefacts.thinned(rows)
    assert len(kept) == 300
    assert [row["iteration"] for row in kept] == sorted((row["iteration"] for row in kept), key=int)
    assert {row["iteration"] for row in kept} >= {str(k) for k in range(9, 1000, 10)}
    assert kept[0] is rows[0]
    assert kept[-1] is rows[-1]
    gaps = np.diff([int(row["iteration"]) for row in kept])
    assert gaps.max() <= 10
    assert artefacts.thinned(rows[:300]) == rows[:300]


def test_a_card_of_runs_that_were_not_scored(agents: Path, tmp_path: Path) -> None:
    shutil.copytree(agents / "mappo_minhealth", tmp_path / "old")
    path = tmp_path / "old" / TASK / "seed0.json"
    record = json.loads(path.read_text())
    del record["result"]
    path.write_text(json.dumps(record))
    assert "| not measured |" in readme(tmp_path / "old")


def test_the_command(trained, tmp_path: Path) -> None:
    options = ["--sweep", str(trained / "sweep.toml"), "--runs", str(trained / "runs"), "--episodes", "4"]
    done = CliRunner().invoke(app, ["collect", *options, "--agents", str(tmp_path)])
    assert done.exit_code == 0, done.output
    assert "3 runs collected" in done.stdout
    assert "1 are unfinished" in done.stdout
    rows = list(csv.DictReader((tmp_path / "mappo_minhealth" / TASK / "seed1.curve.csv").open()))
    assert [row["steps"] for row in rows] == ["20", "40"]


def test_a_bundle_holds_what_its_run_began_with(trained, agents: Path, tmp_path: Path) -> None:
    begun = tmp_path / "begun.safetensors"
    shutil.copy(agents / "mappo_minhealth" / TASK / "seed1.safetensors", begun)
    text = SWEEP.split("[[run]]")[1].replace("actor_hidden", f'initial_policy = "{begun}", actor_hidden')
    (tmp_path / "sweep.toml").write_text("[[run]]" + text.replace("[0, 1, 2]", "[1]"))
    (run,) = sweep.load(tmp_path / "sweep.toml", tmp_path / "runs")
    train(run.settings, run.out, command=run.command)
    list(artefacts.collect([run], tmp_path / "agents", job=FEW))
    place = tmp_path / "agents" / "mappo_minhealth" / TASK
    assert (place / "seed1.initial.safetensors").read_bytes() == begun.read_bytes()
    assert load_agent(place.parent).train_seeds(TASK) == (1,)
    assert f'initial_policy="{TASK}/seedK.initial.safetensors"' in (place.parent / "README.md").read_text()
    begun.write_bytes((place / "seed1.safetensors").read_bytes())
    with pytest.raises(BundleError, match="gone or has changed"):
        list(artefacts.collect([run], tmp_path / "others", job=FEW))
    assert not (tmp_path / "others" / "mappo_minhealth" / TASK / "seed1.safetensors").exists()
