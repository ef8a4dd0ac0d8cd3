"""Many runs from one file: every combination once, what is left, and the files that come along."""

import itertools
import json
import os
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import pytest
from typer.testing import CliRunner

import hipg_bench
from hipg_bench.claims import Claim
from hipg_bench.cli import app
from hipg_bench.errors import ResumeError, SpecError
from hipg_bench.launchers import Local
from hipg_bench.learning import sweep
from hipg_bench.learning.run import train
from hipg_bench.registry import tagged

ROOT = Path(hipg_bench.__file__).resolve().parents[1]
SWEEP = """
[[run]]
tasks = ["coop_nav-3"]
algorithms = ["central", "local"]
seeds = [0, 1]
settings = { num_envs = 4, rollout = 5, steps = 40, actor_hidden = [8], critic_hidden = [8] }
"""


def wait_until(happened: Callable[[], bool]) -> None:
    until = time.monotonic() + 60
    while not happened():
        assert time.monotonic() < until, "too slow"
        time.sleep(0.05)


def test_a_sweep_trains_every_combination_and_only_what_is_missing(tmp_path: Path) -> None:
    (tmp_path / "sweep.toml").write_text(SWEEP)
    runs = sweep.load(tmp_path / "sweep.toml", tmp_path / "out")
    assert [(run.settings.algorithm, run.settings.seed) for run in runs] == [
        ("central", 0), ("local", 0), ("central", 1), ("local", 1)
    ]  # fmt: skip
    done_before = runs[0]
    train(done_before.settings, done_before.out, command="by hand")
    seen: list[int] = []
    sweep.work_off(runs, Local(2), lambda runs: seen.append(sum(run.finished for run in runs)))
    assert seen[-1] == 4
    records = [json.loads((run.out / "train.json").read_text()) for run in runs]
    assert records[0]["command"] == "by hand", "a finished run is left alone"
    assert "--algorithm local" in records[1]["command"]
    # one thread or a process of its own: the same run
    train(runs[1].settings, tmp_path / "again", command="by hand")
    assert (tmp_path / "again" / "policy.safetensors").read_bytes() == (
        runs[1].out / "policy.safetensors"
    ).read_bytes()


def test_a_killed_sweep_leaves_nobody_training_and_goes_on(tmp_path: Path) -> None:
    (tmp_path / "sweep.toml").write_text(SWEEP.replace("steps = 40", "steps = 4000").replace("[0, 1]", "[0]"))
    out = tmp_path / "out"
    command = [sys.executable, "-c", "from hipg_bench.cli import main; main()", "train", "--workers", "1"]
    process = subprocess.Popen(
        [*command, "--sweep", str(tmp_path / "sweep.toml"), "--out", str(out)],
        env=os.environ | {"PYTHONPATH": str(ROOT)}, stdout=subprocess.DEVNULL,
    )  # fmt: skip
    runs = sweep.load(tmp_path / "sweep.toml", out)
    wait_until(lambda: runs[0].done > 0)
    with pytest.raises(ResumeError, match="another process is training here"):
        train(runs[0].settings, runs[0].out, command="beside it")
    process.kill()
    process.wait()
    claim = Claim(runs[0].out)
    wait_until(claim.take)  # the worker lets go
    claim.release()
    assert 0 < runs[0].done < 4000
    train(runs[0].settings, runs[0].out, command="once more")
    train(runs[0].settings, tmp_path / "whole", command="never killed")
    assert (tmp_path / "whole" / "policy.safetensors").read_bytes() == (
        runs[0].out / "policy.safetensors"
    ).read_bytes()


def test_a_sweeps_standing_by_hand(tmp_path: Path) -> None:
    (tmp_path / "sweep.toml").write_text(SWEEP)
    runs = sweep.load(tmp_path / "sweep.toml", tmp_path / "out")  # 40 steps each, 20 an iteration
    assert {one.left for one in sweep.standings(runs, 0.0)} == {None}

    def write(k: int, steps: int, seconds: float, at: float) -> None:
        runs[k].out.mkdir(parents=True)
        (runs[k].out / "train.json").write_text(json.dumps({"env_steps": steps, "seconds": seconds}))
        os.utime(runs[k].out / "train.json", (at, at))

    write(0, 40, 80.0, at=0.0)  # central, 2 s a step
    write(1, 20, 20.0, at=900.0)  # local, 1 s a step; ten iterations take 200 s
    write(2, 20, 100.0, at=0.0)  # central again, 5 s a step; ten iterations take 1000 s
    found = sweep.standings(runs, now=1001.0)
    assert [(one.state, one.steps) for one in found] == [
        ("finished", 40), ("running", 20), ("stopped", 20), ("waiting", 0)
    ]  # fmt: skip
    # what has not begun is local: 40 steps at 1 s
    assert [one.left for one in found] == [0.0, 20.0, 100.0, 40.0]
    shown = CliRunner().invoke(
        app, ["train", "--sweep", str(tmp_path / "sweep.toml"), "--out", str(tmp_path / "out"), "--status"]
    )
    assert "1 finished" in shown.stdout
    assert "1 waiting" in shown.stdout


def test_the_sweeps_that_come_along_are_what_the_comparison_needs(tmp_path: Path) -> None:
    folder = Path(__file__).parent.parent / "sweeps"
    runs = {path.stem: sweep.load(path, tmp_path) for path in folder.glob("*.toml")}
    seeds = {
        name: Counter((run.settings.task, run.algorithm) for run in sweep_runs)
        for name, sweep_runs in runs.items()
    }
    algorithms = ("min_health", "central", "local")
    for task in tagged("standard"):
        wanted = 3 if task.startswith("multiwalker") else 5
        assert all(seeds["standard"][task, algorithm] >= wanted for algorithm in algorithms), task
    for task in tagged("paper"):
        assert all(seeds["paper"][task, algorithm] >= 4 for algorithm in algorithms), task
        assert seeds["paper"][task, "maddpg"] >= 2, task
    assert all(
        seeds["planar"]["multiwalker_planar-3", algorithm] for algorithm in (*algorithms, "maddpg", "qmix")
    )
    # one step of the chain at a time: mask, normalisation, baseline
    chain = [
        next(r.settings for r in runs[name] if (r.settings.task, r.algorithm) == ("paper_comm-10", key))
        for name, key in [
            ("paper", "central"), ("masking", "central-masked"), ("masking", "central-masked_batch"),
            ("masking", "min_health-masked"), ("paper", "min_health"),
        ]
    ]  # fmt: skip
    steps = [
        {key for key, value in before.model_dump().items() if getattr(after, key) != value}
        for before, after in itertools.pairwise(chain)
    ]
    assert steps == [{"mask_dead"}, {"advantage_norm"}, {"algorithm"}, {"mask_dead"}]


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (SWEEP + SWEEP, "label"),
        (SWEEP.replace("central", "centrl"), "algorithm"),
        (SWEEP.replace("seeds", "seds"), r"run\.0\.seds"),
        ("run = 3 =", "not TOML"),
    ],
)
def test_a_wrong_sweep_is_refused(wrong: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "sweep.toml").write_text(wrong)
    with pytest.raises(SpecError, match=message):
        sweep.load(tmp_path / "sweep.toml", tmp_path / "out")
