"""Evaluations that many processes share: the same bytes as one process writes, and nothing mixed."""

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from hipg_bench import task_spec
from hipg_bench.claims import CLAIM
from hipg_bench.cli import app
from hipg_bench.errors import AgentFailure, ResumeError
from hipg_bench.evaluation import blocks, runner
from hipg_bench.evaluation.episodes import EvaluationJob
from hipg_bench.policies.bundle import load_agent

TASKS = ("hazard_nav-4", "coop_nav-3")
SUITE = runner.Suite("custom", tuple(task_spec(task) for task in TASKS))
JOB = EvaluationJob(episodes=70, threads=1)


def files(folder: Path) -> dict[str, bytes]:
    """All files but claims; of results.json, and the page made of it, without the times."""
    found = {
        str(path.relative_to(folder)): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file() and not path.name.startswith(CLAIM) and not path.name.endswith(".sha256")
    }
    results = json.loads(found.pop("results.json"))
    assert found.pop("report.html")
    return found | {"results": json.dumps({**results, "timing": 0}).encode()}


def evaluate(out: Path, *options: str) -> str:
    command = [
        "evaluate",
        "--agent",
        "random",
        "--tasks",
        ",".join(TASKS),
        "--episodes",
        "70",
        "--video",
        "0",
    ]
    done = CliRunner().invoke(app, [*command, "--out", str(out), *options], catch_exceptions=False)
    assert done.exit_code == 0, done.output
    return done.output


def test_shards_write_what_one_process_writes_and_the_last_one_the_results(tmp_path: Path) -> None:
    evaluate(tmp_path / "whole")
    told = evaluate(tmp_path / "parts", "--shard", "1/2", "--workers", "2")
    assert "2 of 4 blocks are left to other shards" in told  # 2 tasks, 70 worlds of 64 + 6
    assert not (tmp_path / "parts" / "results.json").exists()
    evaluate(tmp_path / "parts", "--shard", "2/2", "--workers", "1")
    assert files(tmp_path / "parts") == files(tmp_path / "whole")


@pytest.mark.parametrize(
    ("name", "value"), [("versions", {"mujoco": "2"}), ("suite", "x"), ("agent", "zero")]
)
def test_what_is_of_another_evaluation_is_refused(name: str, value: object, tmp_path: Path) -> None:
    agent = load_agent("random")
    first, *_ = runner.prepare(agent, "random", SUITE, tmp_path, JOB)
    record = json.loads((tmp_path / "run.json").read_text())
    blocks.play(first)
    (first.folder / "run.json").write_text(json.dumps(record | {name: value}))
    with pytest.raises(ResumeError, match=f"{name} is .* there and"):
        runner.evaluate(agent, SUITE, tmp_path, JOB)
    (tmp_path / "run.json").write_text(json.dumps(record | {name: value}))
    with pytest.raises(ResumeError, match=f"{name} is .* there and"):
        runner.prepare(agent, "random", SUITE, tmp_path, JOB)
    with pytest.raises(ResumeError, match=f"{name} is .* there and"):
        blocks.play(first)


class _Failing:
    """Fails in every world."""

    privileged = False

    def initial_state(self, seed, episode_id, num_agents):
        return None

    def act(self, seen, memory, alive):
        raise AgentFailure("crash", "on purpose")


def test_rows_after_a_dnf_are_those_of_worlds_played_in_order() -> None:
    spec, job = SUITE.specs[1], EvaluationJob(episodes=70, threads=1)
    in_order = job.play_all(spec, _Failing())
    # the second block first: nobody there knows yet that 4 failures (5 % of 70) end it
    apart = job.play(spec, _Failing(), list(range(64, 70)), failures=4)
    apart += job.play(spec, _Failing(), list(range(64)), failures=4)
    assert blocks.cut_after_dnf(spec, _Failing(), apart, job) == in_order
