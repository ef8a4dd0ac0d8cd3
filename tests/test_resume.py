"""The product is reproducible: the command twice gives the same bytes, and so does one killed on the way."""

import json
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

import hipg_bench
from hipg_bench.paths import PARTIAL

ROOT = Path(hipg_bench.__file__).resolve().parents[1]


def start(out, *options):
    """The real command in a process of its own."""
    command = [sys.executable, "-c", "from hipg_bench.cli import main; main()", "evaluate", "--video", "0"]
    return subprocess.Popen(
        [*command, "--threads", "1", "--out", str(out), *options],
        env=os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"},
        stdout=subprocess.DEVNULL, stderr=subprocess.PIPE,
    )  # fmt: skip


def finish(process):
    _, said = process.communicate()
    assert process.returncode == 0, said.decode()


def wait_until_playing(process, out):
    while not (out / "run.json").exists() and process.poll() is None:
        time.sleep(0.01)


def rows(out):
    found = {path.name: path.read_bytes() for path in sorted((out / "episodes").glob("*.jsonl"))}
    assert found
    return found


def run_whole(out, *options):
    """Run to the end; return how long it played, in s."""
    process = start(out, *options)
    wait_until_playing(process, out)
    began = time.monotonic()
    finish(process)
    return time.monotonic() - began


def run_killed(out, seconds, kills, *options):
    """Kill the command so many times at random moments and resume it; return how often it was alive."""
    chance = random.Random(7)
    struck = 0
    for _ in range(kills):
        process = start(out, *options)
        wait_until_playing(process, out)
        # in the mean the last kill comes when nearly all is done
        time.sleep(chance.uniform(0, 2) * seconds / (kills + 1))
        struck += process.poll() is None
        process.send_signal(signal.SIGKILL)
        process.communicate()
        for path in out.glob("episodes/*.jsonl"):
            for line in path.read_text().splitlines():
                assert json.loads(line)["status"] == "ok"
    finish(start(out, *options))
    return struck


SMALL = ("--agent", "scripted_blind", "--tasks", "hazard_nav-4,coop_nav-3", "--episodes", "96")


def test_killed_and_resumed_the_rows_are_the_same(tmp_path):
    seconds = run_whole(tmp_path / "whole", *SMALL, "--num-envs", "8")
    (tmp_path / "parts/episodes" / f"{PARTIAL}123").mkdir(parents=True)
    (tmp_path / "parts/episodes" / f"{PARTIAL}123" / "new.jsonl").write_text("half of a li")
    struck = run_killed(tmp_path / "parts", seconds, 3, *SMALL, "--num-envs", "8")
    assert struck >= 1
    assert rows(tmp_path / "parts") == rows(tmp_path / "whole")
    assert not list((tmp_path / "parts").rglob(f"{PARTIAL}*"))


@pytest.mark.long
def test_the_standard_suite_killed_twenty_times(tmp_path):
    suite = ("--agent", "mappo_minhealth", "--episodes", "64", "--num-envs", "16")
    seconds = run_whole(tmp_path / "whole", *suite)
    struck = run_killed(tmp_path / "parts", seconds, 20, *suite)
    assert struck >= 15
    assert rows(tmp_path / "parts") == rows(tmp_path / "whole")


@pytest.mark.long
@pytest.mark.parametrize("split", ["standard", "shift", "forced_death", "ad_hoc"])
def test_the_standard_suite_twice_gives_the_same_bytes(tmp_path, split):
    suite = ("--agent", "mappo_minhealth", "--episodes", "64", "--split", split)
    run_whole(tmp_path / "first", *suite)
    run_whole(tmp_path / "second", *suite, "--num-envs", "13", "--threads", "2")
    assert rows(tmp_path / "second") == rows(tmp_path / "first")
