"""The bench: what takes turns, what runs apart, and that every section says what it claims to say."""

import importlib.util
import json
import os
import subprocess
import sys
import time
import tracemalloc

import numpy as np
import pytest
from PIL import Image

from hipg_bench import make, task_spec
from hipg_bench.errors import HipgError, SpecError, UnknownNameError
from hipg_bench.evaluation.bench import (
    adapters,
    child,
    films,
    plan,
    plot,
    scaling,
    scoring,
    start,
    steps,
    timing,
)
from hipg_bench.evaluation.bench.child import Job
from hipg_bench.evaluation.bench.timing import Contender, Times, in_turn
from hipg_bench.learning.bench import iteration_time
from hipg_bench.rendering import gl

TASK = "hazard_nav-4"
SPEC = task_spec(TASK)
CLI = [sys.executable, "-c", "from hipg_bench.cli import main; main()", "bench"]


def bench(*args):
    done = subprocess.run([*CLI, *map(str, args)], capture_output=True, text=True, timeout=120, check=False)
    assert "Traceback" not in done.stderr
    return done


# --- timing


def test_a_ratio_is_the_median_of_pairs_not_the_ratio_of_medians():
    times = Times({"a": np.array([1.0, 10.0, 2.0]), "b": np.array([2.0, 20.0, 1000.0])})
    assert times.ratio("b", "a") == 2
    assert times.median("b") / times.median("a") == 10


@pytest.fixture
def clock(monkeypatch):
    """A clock that only ``clock.advance`` moves."""

    class Clock:
        now = 0.0

        def advance(self, seconds):
            self.now += seconds

    clock = Clock()
    monkeypatch.setattr(timing.time, "perf_counter", lambda: clock.now)
    return clock


def test_contenders_take_turns_with_as_many_calls_each():
    order = []
    runs = {name: Contender(lambda name=name: order.append(name)) for name in "abc"}
    times = in_turn(runs, 0.0, calls=2)
    assert {len(taken) for taken in times.rounds.values()} == {3}
    assert "".join(order) == "abc" + "aabbcc" + "ccbbaa" + "aabbcc"


def test_a_turn_of_the_slowest_takes_50_ms_and_preparation_is_not_timed(clock):
    calls = []

    def work(name, seconds):
        calls.append(name)
        clock.advance(seconds)

    times = in_turn(
        {
            "slow": Contender(lambda: work("slow", 5e-3)),
            "quick": Contender(lambda: work("quick", 1e-3), prepare=lambda: clock.advance(7.0)),
        },
        30.0,
    )
    # a round takes 7 s and 60 ms
    assert len(times.rounds["slow"]) == 5
    assert calls.count("slow") == calls.count("quick") == 1 + 2 + 5 * 10
    assert times.median("slow") == pytest.approx(5e-3)
    assert times.ratio("slow", "quick") == pytest.approx(5)


def test_what_takes_longer_than_a_turn_is_called_once_in_each(clock):
    times = in_turn({"slow": Contender(lambda: clock.advance(2.0))}, 0.0)
    assert clock.now == pytest.approx((1 + 3) * 2.0)
    assert times.median("slow") == pytest.approx(2)


# --- processes


def test_memory_is_that_of_the_measured_process_alone():
    mine = np.ones(50_000_000)  # 400 MB, which a process forked from this one would be charged with
    (row,) = child.run(Job("reset", steps.reset_time, (SPEC, 4, 1, 0.0)))
    assert 20 < row.peak_mb < 300 < mine.nbytes / 1e6
    assert child.peak_memory() > 400


@pytest.mark.parametrize(
    ("function", "arguments", "kind", "message"),
    [
        (scoring.scoring_time, ("randm", (SPEC,), 1, 1), UnknownNameError, "did you mean 'random'"),
        (os._exit, (3,), HipgError, "ended with code 3"),
        (json.loads, ("{",), HipgError, "bench x: json.decoder.JSONDecodeError"),
    ],
)
def test_what_goes_wrong_in_a_process_is_told(function, arguments, kind, message):
    with pytest.raises(kind, match=message):
        child.run(Job("x", function, arguments))


def test_a_process_gets_its_variables_before_anything_is_imported():
    # a backend that MuJoCo refuses when it is imported
    with pytest.raises(HipgError, match="invalid value for environment variable MUJOCO_GL"):
        child.run(Job("reset", steps.reset_time, (SPEC, 1, 1, 0.0), {"MUJOCO_GL": "nonsense"}))


# --- sections


def test_step_rates_agree_with_a_plain_loop():
    (rate,) = steps.step_rate(SPEC, 8, 1, 0.3)
    env = make(TASK, 8, threads=1)
    env.reset()
    action = np.zeros((8, env.num_agents, env.action_size))
    started = time.perf_counter()
    for _ in range(50):
        env.step(action)
    plain = 8 * 50 / (time.perf_counter() - started)
    assert plain / 10 < rate.env_steps < plain * 10
    assert rate.agent_steps == pytest.approx(4 * rate.env_steps)
    # eight worlds of four drones: Python takes most of a step
    assert 0 < rate.share < 0.9


def test_worlds_are_timed_in_the_midst_of_their_episodes():
    env, step = steps.stepping(SPEC, SPEC.horizon, 1)
    ended = [
        int((seen.terminated | seen.truncated).sum()) for seen in (step.call() for _ in range(SPEC.horizon))
    ]
    assert ended == [1] * SPEC.horizon
    assert env.num_envs == SPEC.horizon


@pytest.mark.parametrize("task", [TASK, "multiwalker-3"])
def test_a_long_run_needs_no_more_memory_than_a_short_one(task):
    _, step = steps.stepping(task_spec(task), 4, 1)
    tracemalloc.start()
    try:
        held: list[int] = []
        for _ in range(3):
            for _ in range(30):
                step.call()
            held.append(tracemalloc.get_traced_memory()[0])
    finally:
        tracemalloc.stop()
    assert held[2] - held[1] < 10_000


def test_resets_cost_more_per_world_when_there_is_one():
    (one,), (many,) = (steps.reset_time(SPEC, size, 1, 0.1) for size in (1, 64))
    assert one.per_world_us > 2 * many.per_world_us
    assert many.reset_ms == pytest.approx(64 * many.per_world_us / 1e3)
    assert 0 < many.in_steps < 50


@pytest.mark.skipif(gl.working_backend() is None, reason="no OpenGL works here")
def test_films_are_timed_frame_by_frame():
    backend = gl.working_backend()
    job = Job("render", films.film_time, (SPEC, (128, 72), backend, 8, 1), gl.environment(backend))
    (row,) = child.run(job)
    assert row.over_bare == pytest.approx(row.film_ms / row.bare_ms - 1)
    assert 0.5 < row.film_ms < 1e3 * row.start_s
    assert row.peak_mb > 50


def test_training_is_split_into_its_parts():
    (row,) = iteration_time(TASK, 1, 0.0, {"num_envs": 8, "rollout": 5, "epochs": 1, "minibatches": 1})
    assert row.rollout_share + row.credit_share + row.update_share == pytest.approx(1, abs=0.15)
    assert min(row.rollout_share, row.credit_share, row.update_share) > 0
    assert row.agent_steps == pytest.approx(8 * 5 * 4 / row.seconds)
    with pytest.raises(SpecError, match="hazard_nav-4"):
        iteration_time(TASK, 1, 0.0, {"epochs": 0})


def test_scoring_counts_every_episode():
    *tasks, whole = scoring.scoring_time("random", (SPEC, task_spec("coop_nav-3")), 3, 1)
    assert [(row.task, row.episodes) for row in tasks] == [(TASK, 3), ("coop_nav-3", 3)]
    assert (whole.task, whole.episodes) == ("all", 6)
    assert whole.seconds > sum(row.seconds for row in tasks)


def test_start_is_timed_beyond_that_of_python():
    python, sleeper = start.start_times(0.0, {"sleeper": "import time, decimal; time.sleep(0.2)"})
    assert python.beyond_python_ms == 0
    assert 100 < sleeper.beyond_python_ms < sleeper.ms
    assert "decimal" not in python.imports


@pytest.mark.parametrize("num_envs", [1, 3])
def test_every_face_is_measured_or_says_why_not(num_envs):
    rows = {row.adapter: row for row in adapters.overheads(SPEC, num_envs, 1, 0.0)}
    needs = {"gymnasium vector": "gymnasium", "stable-baselines3": "stable_baselines3", "torchrl": "torchrl"}
    if num_envs == 1:
        needs |= {"pettingzoo": "pettingzoo", "rllib": "ray", "gymnasium": "gymnasium", "dm_env": "dm_env"}
    assert rows.keys() == needs.keys()
    for adapter, library in needs.items():
        row = rows[adapter]
        if importlib.util.find_spec(library) is None:
            assert library in row.left_out
            assert row.overhead is None
        else:
            assert not row.left_out
            assert row.step_us > 0
            assert row.overhead > -0.9
    # all stood beside the same worlds
    assert len({row.batch_us for row in rows.values()} - {None}) == 1


def test_growth_is_relative_to_the_smallest():
    two, eight = scaling.over_agents(SPEC, (2, 8), 64, 1, 0.3)
    assert (two.num_agents, two.growth, two.growth_per_agent) == (2, 1, 1)
    assert eight.growth > 1
    assert eight.growth_per_agent == pytest.approx(eight.growth / 4)
    one, many = scaling.over_worlds(SPEC, (1, 64), 1, 0.3)
    assert (one.growth, one.step_us > many.step_us) == (1, True)
    assert many.growth < 0.5


# --- requests and documents


def test_a_request_fills_in_what_was_left_open():
    cores = len(os.sched_getaffinity(0))
    quick, full = (plan.make_plan([SPEC], full=whole) for whole in (False, True))
    assert (quick.num_envs, quick.threads) == ((1, 64, 1024), (cores,))
    assert full.num_envs == (1, 64, 1024, 4096)
    assert (full.threads[0], full.threads[-1]) == (1, cores)
    assert plan.make_plan([SPEC], num_envs=[8, 2], threads=[0, 1], seconds=0.5).threads == full.threads[
        :1
    ] + ((cores,) if cores > 1 else ())


def test_the_document_holds_rows_machine_versions_and_settings(tmp_path):
    picture = tmp_path / "speed.png"
    done = bench(
        "steps", "scaling", "--tasks", TASK, "--num-envs", "1,4", "--threads", 1, "--seconds", 0.05, "--json",
        "--plot", picture,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    document = json.loads(done.stdout)
    assert document.keys() == {"schema", "machine", "versions", "settings", "seconds", "sections"}
    assert document["schema"] == plan.SCHEMA
    assert document["machine"]["cores"] >= 1
    assert document["versions"].keys() >= {"hipg-bench", "mujoco", "numpy"}
    assert document["settings"]["specs"] == {TASK: SPEC.fingerprint}
    assert document["settings"]["num_envs"] == [1, 4]
    rates = document["sections"]["steps"]
    assert [(rate["task"], rate["num_envs"], rate["threads"]) for rate in rates] == [
        (TASK, 1, 1),
        (TASK, 4, 1),
    ]
    assert all(50 < rate["peak_mb"] < 500 for rate in rates)
    sweeps = [(row["sweep"], row["num_agents"], row["num_envs"]) for row in document["sections"]["scaling"]]
    assert sweeps == [("agents", n, 4) for n in (2, 4, 8, 16, 31)] + [("worlds", 4, 1), ("worlds", 4, 4)]
    with Image.open(picture) as image:
        assert image.width > 2 * image.height
        assert len(image.convert("RGB").resize((200, 80)).getcolors(16000)) > 50


def test_a_table_shows_the_same(tmp_path):
    done = bench("steps", "--tasks", f"{TASK},coop_nav-3", "--num-envs", 2, "--threads", 1, "--seconds", 0.05)
    assert done.returncode == 0, done.stderr
    lines = [line.split() for line in done.stdout.splitlines() if line.startswith((TASK, "coop_nav-3"))]
    assert [line[:3] for line in lines] == [[TASK, "1", "2"], ["coop_nav-3", "1", "2"]]
    assert all(line[6].endswith("%") for line in lines)


def test_a_plot_needs_something_to_draw(tmp_path):
    with pytest.raises(HipgError, match="steps or scaling"):
        plot.draw({"sections": {"start": []}, "machine": {}}, tmp_path / "x.png")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("args", "message"),
    [
        (("stps",), "no section 'stps'; did you mean 'steps'?"),
        (("steps", "--plot", "speed.txt"), ".png, .svg, .pdf"),
        (("steps", "--threads", "two"), "whole numbers >= 0"),
        (("--tasks", "multiwalkr-3", "steps"), "did you mean 'multiwalker-3'?"),
    ],
)
def test_mistakes_are_told_before_anything_is_measured(args, message):
    done = bench(*args)
    assert done.returncode == 2
    assert message in done.stderr
    assert done.stdout == ""
