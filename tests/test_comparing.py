"""Evaluations side by side, and as marl-eval's own loader reads them."""

import json

import numpy as np
import pytest
from typer.testing import CliRunner

from hipg_bench import task_spec
from hipg_bench.cli import app
from hipg_bench.errors import HipgError
from hipg_bench.evaluation import comparing, runner
from hipg_bench.evaluation.episodes import EvaluationJob
from hipg_bench.evaluation.export import marl_eval
from hipg_bench.policies.bundle import load_agent

TASKS = ("hazard_nav-4", "coop_nav-3")


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    out = tmp_path_factory.mktemp("runs")
    suite = runner.Suite("custom", tuple(task_spec(task) for task in TASKS))
    for name, split in (("random", "standard"), ("zero", "standard"), ("zero", "forced_death")):
        job = EvaluationJob(episodes=3, threads=1, split=split)
        runner.evaluate(load_agent(name), suite, out / f"{name}-{split}", job)
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
    assert "one run of each: the first scores higher on" in done.output
    assert "P(improvement)" not in done.output
    # neither is trained, so neither has a place
    assert done.output.count("reference") == 2
    for task in TASKS:
        assert task in done.output


def evaluated(agent, tasks, out, episodes=3):
    suite = runner.Suite("custom", tuple(task_spec(task) for task in tasks))
    return runner.evaluate(load_agent(agent), suite, out, EvaluationJob(episodes=episodes, threads=1))


def test_only_tasks_in_common_are_ranked(folders, tmp_path):
    """The score of what both played is that of an evaluation of those tasks alone."""
    evaluated("zero", ("coop_nav-3", "paper_coop_nav-3"), tmp_path / "zero")
    alone = {
        name: evaluated(name, ("coop_nav-3",), tmp_path / f"{name}-alone")["aggregate"]
        for name in ("random", "zero")
    }
    found = comparing.on_common_tasks({"random": folders / "random-standard", "zero": tmp_path / "zero"})
    for name, results in found.items():
        assert [task["task"] for task in results["tasks"]] == ["coop_nav-3"]
        assert results["aggregate"] == alone[name]
    done = CliRunner().invoke(app, ["compare", str(folders / "random-standard"), str(tmp_path / "zero")])
    assert "ranked on what all played: coop_nav-3\n" in done.output
    assert "paper_coop_nav-3" not in done.output

    evaluated("zero", ("paper_coop_nav-3",), tmp_path / "other")
    with pytest.raises(HipgError, match="no scored task was played by all"):
        comparing.on_common_tasks({"a": folders / "random-standard", "b": tmp_path / "other"})


def test_several_runs_have_a_chance_of_improvement(tmp_path):
    from hipg_bench.cli.compare import _verdict

    def side(*scores):
        runs = [{"score": score} for score in scores]
        return {
            "tasks": [{"task": "t", "score": np.mean(scores), "runs": runs}], "aggregate": {"scored": ["t"]},
        }  # fmt: skip

    # 5 of the 6 pairs have the first above the second
    assert _verdict(side(0.9, 0.5, 0.7), side(0.6, 0.1)).startswith("P(improvement) 0.83")
    assert "higher on 1 of 1 tasks" in _verdict(side(0.9), side(0.6))


def test_agents_are_evaluated_where_the_others_were(folders, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    args = ["compare", "scripted", str(folders / "zero-standard")]
    for _ in range(2):
        done = CliRunner().invoke(app, args, catch_exceptions=False)
        assert done.exit_code == 0
    (folder,) = (tmp_path / "runs").iterdir()  # the second time it was there already
    results = json.loads((folder / "results.json").read_text())
    assert [task["task"] for task in results["tasks"]] == list(TASKS)
    assert (results["episodes_per_policy"], results["seed"], results["split"]) == (3, 1000, "standard")
    assert "higher on 2 of 2 tasks" in done.output
    for wrong in (["zero"], ["zero", "zero"], ["zero", "nobody"], ["zero", str(tmp_path)]):
        assert isinstance(CliRunner().invoke(app, ["compare", *wrong]).exception, HipgError)
