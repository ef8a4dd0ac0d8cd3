"""Evaluations side by side, and as marl-eval's own loader reads them."""

import json

import numpy as np
import pytest
from typer.testing import CliRunner

from hipg_bench import task_spec
from hipg_bench.cli import app
from hipg_bench.errors import HipgError
from hipg_bench.evaluation import comparing, runner
from hipg_bench.evaluation.episodes import Plan
from hipg_bench.evaluation.export import marl_eval
from hipg_bench.policies.bundle import load_agent

TASKS = ("hazard_nav-4", "coop_nav-3")


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    out = tmp_path_factory.mktemp("runs")
    suite = runner.Suite("custom", tuple(task_spec(task) for task in TASKS))
    for name, split in (("random", "standard"), ("zero", "standard"), ("zero", "forced_death")):
        plan = Plan(episodes=3, threads=1, split=split)
        runner.evaluate(load_agent(name), suite, out / f"{name}-{split}", plan)
    return out


def test_every_level_is_what_marl_eval_expects(folders):
    """The walk of `marl_eval.utils.data_processing_utils.data_process_pipeline`, 0.0.4."""
    document = json.loads(json.dumps(marl_eval(sorted(folders.iterdir())), allow_nan=False))
    assert set(document) == {"hipg_bench", "hipg_bench_forced_death"}
    assert set(document["hipg_bench"]) == set(TASKS)
    for tasks in document.values():
        for algorithms in tasks.values():
            for algorithm, runs in algorithms.items():
                assert "," not in algorithm
                for steps in runs.values():
                    assert list(steps) == ["step_0", "absolute_metrics"]
                    assert "step_count" in steps["step_0"]
                    for metrics in steps.values():
                        for name, values in metrics.items():
                            if name != "step_count":
                                assert len(values) == 3
                                assert np.isfinite(np.mean(values))


def test_the_numbers_are_those_of_the_rows(folders):
    document = marl_eval([folders / "random-standard"])
    lines = (folders / "random-standard/episodes/hazard_nav-4.jsonl").read_text().splitlines()
    rows = [json.loads(line) for line in lines]
    run = document["hipg_bench"]["hazard_nav-4"]["random"]["seed_0"]
    for name in ("return", "score", "survival", "deaths"):
        assert run["absolute_metrics"][name] == [row[name] for row in rows]
        assert run["step_0"][name] == run["absolute_metrics"][name]


def test_bad_folders_are_refused(folders, tmp_path):
    with pytest.raises(HipgError, match="not a finished evaluation"):
        marl_eval([tmp_path])
    with pytest.raises(HipgError, match="zero on hazard_nav-4, standard, is there already"):
        marl_eval([folders / "zero-standard"] * 2)
    (tmp_path / "results.json").write_text('{"schema": 1}')
    with pytest.raises(HipgError, match="schema 2 is allowed, got 1"):
        marl_eval([tmp_path])


def test_two_agents_are_compared_in_the_same_worlds(folders):
    found = comparing.differences(folders / "random-standard", folders / "zero-standard")
    assert set(found) == set(TASKS)
    for task, (difference, (low, high)) in found.items():
        scores = {
            name: [
                json.loads(line)["score"]
                for line in (folders / f"{name}-standard/episodes/{task}.jsonl").read_text().splitlines()
            ]
            for name in ("random", "zero")
        }
        gaps = np.subtract(scores["random"], scores["zero"])
        assert difference == pytest.approx(gaps.mean())
        # of three worlds drawn with replacement the extremes are three times the same
        assert gaps.min() - 1e-9 <= low <= high <= gaps.max() + 1e-9
    with pytest.raises(HipgError, match="are of other worlds: split is standard and forced_death"):
        comparing.differences(folders / "zero-standard", folders / "zero-forced_death")


def test_the_comparison_is_printed(folders):
    done = CliRunner().invoke(
        app, ["compare", str(folders / "random-standard"), str(folders / "zero-standard")]
    )
    assert done.exit_code == 0, done.output
    assert "P(improvement)" in done.output
    # neither is trained, so neither has a place
    assert done.output.count("reference") == 2
    for task in TASKS:
        assert task in done.output
