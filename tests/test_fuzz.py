"""Whatever strangers hand over is taken, or refused in our own words; nothing appears outside its folder.

A few hundred mutations of every kind run with the tests, 100,000 with `make test-long`; the seed is fixed.
"""

import contextlib
import io
import os
import random
import resource
import shutil
import sys
import warnings
from pathlib import Path

import jaxtyping
import pytest
from mutations import (
    command_lines,
    damaged,
    mutated_command,
    mutated_row,
    mutated_text,
    mutated_zip,
)
from test_verify import TASK, network, zipped

from hipg_bench import spec as specs
from hipg_bench import task_spec
from hipg_bench.cli import app
from hipg_bench.errors import HipgError
from hipg_bench.evaluation import runner
from hipg_bench.evaluation.episodes import EvaluationJob
from hipg_bench.evaluation.rows import read_rows
from hipg_bench.leaderboard.adding import _points
from hipg_bench.learning import checkpoint, sweep
from hipg_bench.paths import data_folder
from hipg_bench.policies.bundle import load_agent
from hipg_bench.policies.card import read_card
from hipg_bench.policies.network import load_network
from hipg_bench.registry import make
from hipg_bench.submissions import archive

SPEC = task_spec(TASK)


@pytest.fixture(autouse=True)
def unchecked():
    """As users run it: the tests' own checks of types would refuse first."""
    jaxtyping.config.update("jaxtyping_disable", True)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # zipfile's, of names that we double
        yield
    jaxtyping.config.update("jaxtyping_disable", False)


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    """One sound file of each kind."""
    place = tmp_path_factory.mktemp("good")
    suite = runner.Suite("custom", (SPEC.override(horizon=5),))
    runner.evaluate(load_agent("scripted"), suite, place / "e", EvaluationJob(episodes=2, threads=1))
    folder = network(place / "newcomer")
    return {
        "rows": (place / "e" / "episodes" / f"{TASK}.jsonl").read_text().splitlines()[0],
        "card": (folder / "agent.toml").read_text() + '[training]\nhours = 1.0\nhardware = "x"\n',
        "policy": (folder / TASK / "seed0.safetensors").read_bytes(),
        "curve": (folder / TASK / "seed0.curve.csv").read_text(),
        "zip": zipped(folder).read_bytes(),
        "spec": (data_folder("tasks") / f"{TASK}.toml").read_text(),
        "results": (place / "e" / "results.json").read_bytes(),
        "sweep": '[[run]]\ntasks = ["coop_nav-3"]\nseeds = [0]\nsettings = { steps = 8, num_envs = 2 }\n',
    }


def play_a_spec(path):
    spec = specs.load(path)
    if spec.num_agents <= 8 and spec.horizon <= 10_000 and spec.control_step <= 1:
        env = make(spec, 1, threads=1)
        env.reset()


def check(kind, good, chance, place):
    """One mutation of one kind of file."""
    path = place / "file"
    if kind == "rows":
        read_rows(mutated_row(good["rows"], chance), "rows", SPEC)
    elif kind == "card":
        path.write_bytes(mutated_text(good["card"], chance))
        read_card(path)
    elif kind == "policy":
        path.write_bytes(damaged(good["policy"], chance))
        load_network(path)
    elif kind == "curve":
        path.write_bytes(mutated_text(good["curve"], chance))
        list(_points(path, "return"))
    elif kind == "zip":
        path.write_bytes(mutated_zip(good["zip"], chance, place))
        archive.unpack(path, place / "unpacked")
    elif kind == "spec":
        path = place / f"{TASK}.toml"
        path.write_bytes(mutated_text(good["spec"], chance))
        play_a_spec(path)
    elif kind == "checkpoint":
        path.write_bytes(damaged(b"PK\3\4" + good["policy"][:500], chance))
        checkpoint.load(path)
    elif kind == "sweep":
        path.write_bytes(mutated_text(good["sweep"], chance))
        sweep.load(path, place / "runs")
    else:
        folder = place / "results"
        folder.mkdir(exist_ok=True)
        (folder / "results.json").write_bytes(damaged(good["results"], chance))
        from hipg_bench.evaluation.comparing import read

        read(folder)


KINDS = ("rows", "card", "policy", "curve", "zip", "spec", "checkpoint", "sweep", "results")


def go_through(kind, good, place, count, seed):
    """Check so many mutations; return how many were refused."""
    chance, refused = random.Random(f"{kind} {seed}"), 0
    for _ in range(count):
        try:
            check(kind, good, chance, place)
        except HipgError:
            refused += 1
        shutil.rmtree(place / "unpacked", ignore_errors=True)
    return refused


def outside(place):
    """What lies beside the folder of the attempts."""
    return sorted(str(path) for path in place.parent.rglob("*") if place not in path.parents)


@pytest.mark.parametrize("kind", KINDS)
def test_mutated_files_are_taken_or_refused_in_our_words(kind, good, tmp_path):
    place = tmp_path / "attempts"
    place.mkdir()
    before = outside(place)
    count = 60 if kind in ("spec", "zip") else 400
    refused = go_through(kind, good, place, count, 0)
    assert refused > 0 or kind == "curve"  # of a curve, what is no number is left out
    assert outside(place) == before


def run_commands(place, count, seed):
    """Mutated command lines in this process; anything but an answer in our words is raised."""
    chance = random.Random(seed)
    lines = command_lines(place)
    for _ in range(count):
        words = mutated_command(chance.choice(lines), chance)
        shutil.rmtree(place, ignore_errors=True)
        place.mkdir()
        os.chdir(place)
        out, err = io.StringIO(), io.StringIO()
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            try:
                app(words, standalone_mode=False)
            except (HipgError, SystemExit):
                pass
            except Exception as error:
                # the command line's own library says what is wrong with options
                if type(error).__module__.split(".")[0] not in ("click", "typer"):
                    raise AssertionError(f"{words}: {type(error).__name__}: {error}") from error
        assert "Traceback" not in out.getvalue() + err.getvalue(), words


def test_mutated_commands_are_answered_in_our_words(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    place = tmp_path / "attempts"
    place.mkdir()
    before = outside(place)
    run_commands(place, 40, 0)
    assert outside(place) == before


@pytest.mark.long
def test_a_hundred_thousand_mutations(good, tmp_path, monkeypatch):
    """The soak: no traceback, no file outside, no process left, bounded memory."""
    place = tmp_path / "attempts"
    place.mkdir()
    before = outside(place)
    for kind in KINDS:
        go_through(kind, good, place, 200, 1)
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for kind in KINDS:
        slow = kind in ("spec", "zip", "sweep")
        go_through(kind, good, place, 2_000 if slow else 15_500, 2)
    monkeypatch.chdir(tmp_path)
    run_commands(place, 1_000, 3)
    assert outside(place) == before
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss < memory + 500_000  # kB
    if sys.platform == "linux":
        children = [
            child
            for task in Path("/proc/self/task").iterdir()
            for child in (task / "children").read_text().split()
        ]
        assert not children
