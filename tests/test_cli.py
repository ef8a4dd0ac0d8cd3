"""The command line in processes of its own: exit codes, messages, files, interruption."""

import json
import os
import re
import signal
import subprocess
import sys
import time

import pytest

from hipg_bench import make, task_spec, tasks
from hipg_bench.claims import CLAIM
from hipg_bench.paths import PARTIAL
from hipg_bench.rendering import gl

# a test run in the background ignores SIGINT, and so would its children
MAIN = (
    "import signal; signal.signal(signal.SIGINT, signal.default_int_handler);"
    "from hipg_bench.cli import main; main()"
)
TASK = "hazard_nav-4"


def command(*args):
    return [sys.executable, "-c", MAIN, *map(str, args)]


def run(*args, cwd=None, **environment):
    return subprocess.run(
        command(*args), capture_output=True, text=True, timeout=120, cwd=cwd, check=False,
        env=os.environ | environment,
    )  # fmt: skip


def test_help_is_quick_because_it_imports_nothing_heavy():
    code = (
        "import sys, hipg_bench.cli;"
        "print({'numpy', 'mujoco', 'torch', 'pydantic', 'scipy', 'matplotlib'} & set(sys.modules))"
    )
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout == "set()\n"
    done = run("--help")
    assert done.returncode == 0
    for name in ("evaluate", "train", "tasks", "agents", "calibrate", "bench"):
        assert name in done.stdout


@pytest.mark.parametrize(
    ("args", "message"),
    [
        (
            ("evaluate", "--tasks", "hazard_nv-4", "--agent", "zero"),
            "no task 'hazard_nv-4'; did you mean 'hazard_nav-4'?",
        ),
        (("evaluate", "--agent", "randm"), "no agent 'randm'; did you mean 'random'?"),
        (("tasks", "show", "multwalker-3"), "did you mean 'multiwalker-3'?"),
        (("agents", "show", "scriptd"), "did you mean 'scripted'?"),
        (("calibrate", "hazard_nav4"), "did you mean 'hazard_nav-4'?"),
        (("evaluate", "--episodes", "0"), "--episodes"),
        (("evaluate", "--agent", "scripted", "--tasks", "multiwalker-3"), "plays none of these tasks"),
    ],
)
def test_mistakes_are_told_in_a_line_with_exit_code_2(args, message, tmp_path):
    done = run(*args, cwd=tmp_path)
    assert done.returncode == 2
    assert message in done.stderr
    assert "Traceback" not in done.stderr
    assert done.stdout == ""
    assert list(tmp_path.iterdir()) == []


def test_evaluate_end_to_end(tmp_path):
    args = (
        "evaluate",
        "--agent",
        "random",
        "--tasks",
        f"{TASK},multiwalker-3",
        "--episodes",
        6,
        "--video",
        0,
    )
    done = run(*args, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    # not a terminal: no progress bars, and the first plain line comes after 30 s; rules may be compiled
    assert [line for line in done.stderr.splitlines() if "compiling the rules" not in line] == []
    (folder,) = (tmp_path / "runs").iterdir()
    assert folder.name.startswith("random-")
    names = {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}
    names = {name for name in names if not name.startswith(CLAIM)}
    assert names == {
        "run.json", "results.json", "report.html",
        f"episodes/{TASK}.jsonl", "episodes/multiwalker-3.jsonl",
        f"episodes/.{TASK}.jsonl.sha256", "episodes/.multiwalker-3.jsonl.sha256",
    }  # fmt: skip
    results = json.loads((folder / "results.json").read_text())
    assert [task["task"] for task in results["tasks"]] == [TASK, "multiwalker-3"]
    for task in results["tasks"]:
        assert task["episodes"] == 6
        assert f"{task['return_mean']:.1f}" in done.stdout
        assert sum(task["end_reasons"].values()) == 6
    assert "6 episodes per policy: not for comparison" in done.stdout


def test_evaluate_prints_json_for_scripts(tmp_path):
    done = run(
        "evaluate",
        "--agent",
        "zero",
        "--tasks",
        TASK,
        "--episodes",
        2,
        "--video",
        0,
        "--json",
        "--out",
        tmp_path,
    )
    assert json.loads(done.stdout) == json.loads((tmp_path / "results.json").read_text())


def test_the_same_command_gives_the_same_bytes_whatever_the_batch(tmp_path):
    rows = set()
    for num_envs, threads in ((1, 1), (7, 2), (64, 1)):
        out = tmp_path / f"{num_envs}"
        done = run(
            "evaluate", "--agent", "scripted_blind", "--tasks", TASK, "--episodes", 66, "--video", 0,
            "--num-envs", num_envs, "--threads", threads, "--out", out,
        )  # fmt: skip
        assert done.returncode == 0, done.stderr
        rows.add((out / f"episodes/{TASK}.jsonl").read_bytes())
    assert len(rows) == 1


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGKILL])
def test_interrupted_then_resumed_gives_the_same_rows(tmp_path, how):
    args = ["evaluate", "--agent", "random", "--tasks", TASK, "--episodes", 200, "--video", 0, "--threads", 1]
    rows = tmp_path / "cut" / "episodes" / f"{TASK}.jsonl"
    child = subprocess.Popen(
        command(*args, "--num-envs", 1, "--out", tmp_path / "cut"), stderr=subprocess.PIPE, text=True
    )
    until = time.monotonic() + 60
    while not (rows.exists() and rows.read_text().count("\n") > 5):
        assert child.poll() is None, "it ended before it could be interrupted"
        assert time.monotonic() < until
        time.sleep(0.01)
    os.kill(child.pid, how)
    _, said = child.communicate(timeout=30)
    if how == signal.SIGINT:
        assert child.returncode == 130
        assert "Traceback" not in said
        assert not list((tmp_path / "cut").rglob(f"{PARTIAL}*"))
    partial = rows.read_text()
    assert partial.endswith("}\n")
    assert partial.count("\n") < 200
    assert run(*args, "--out", tmp_path / "cut").returncode == 0
    assert run(*args, "--out", tmp_path / "whole").returncode == 0
    whole = (tmp_path / "whole" / "episodes" / f"{TASK}.jsonl").read_text()
    assert whole.startswith(partial)
    assert rows.read_text() == whole


# neither EGL nor OSMesa finds a driver
NO_GL = {"MUJOCO_EGL_DEVICE_ID": "99", "LIBGL_DRIVERS_PATH": "/nonexistent", "GALLIUM_DRIVER": "none"}


def test_without_graphics_the_scores_still_come(tmp_path):
    args = ("evaluate", "--agent", "zero", "--tasks", TASK, "--episodes", 3, "--out", tmp_path)
    done = run(*args, **NO_GL)
    assert done.returncode == 0
    assert TASK in done.stdout
    assert "apt-get install" in done.stderr
    assert "apt-get install" in (tmp_path / "report.html").read_text()
    assert list((tmp_path / "videos").glob("*") if (tmp_path / "videos").exists() else []) == []
    # the same command where graphics work goes on to make the film
    assert (tmp_path / "films" / f"{TASK}.npz").exists()


@pytest.mark.skipif(gl.working_backend() is None, reason="no OpenGL here")
def test_interrupted_while_filming_leaves_no_half_film(tmp_path):
    args = ("evaluate", "--agent", "zero", "--tasks", TASK, "--episodes", 3, "--out", tmp_path)
    child = subprocess.Popen(command(*args), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    videos, until = tmp_path / "videos", time.monotonic() + 60
    while not (videos.exists() and list(videos.iterdir())):
        assert child.poll() is None, child.stderr.read()
        assert time.monotonic() < until
        time.sleep(0.01)
    os.kill(child.pid, signal.SIGINT)
    told, said = child.communicate(timeout=60)
    assert child.returncode == 130
    assert "Traceback" not in said
    assert list(videos.iterdir()) == []
    # the scores were told before, and are kept
    assert re.search(rf"^{TASK} +-?\d", told, re.MULTILINE)
    assert json.loads((tmp_path / "results.json").read_text())["film_trouble"] == ["interrupted"]
    assert "resumes" in said


def test_a_folder_of_another_run_is_refused(tmp_path):
    args = ["evaluate", "--tasks", TASK, "--episodes", 2, "--video", 0, "--out", tmp_path]
    assert run(*args, "--agent", "zero").returncode == 0
    done = run(*args, "--agent", "random")
    assert done.returncode == 2
    assert "agent is 'zero' there and 'random' here" in done.stderr


def test_task_tables_are_those_of_the_environment():
    env = make("hazard_comm-10")
    shown = json.loads(run("tasks", "show", "hazard_comm-10", "--json").stdout)
    assert (shown["task"], shown["fingerprint"]) == (
        "hazard_comm-10",
        task_spec("hazard_comm-10").fingerprint,
    )
    sizes = {"observation": env.observation_size, "action": env.action_size, "state": env.state_size}
    for name, size in sizes.items():
        columns = [
            column
            for block in shown["vectors"][name]
            for column in range(block["columns"][0], block["columns"][1] + 1)
        ]
        assert columns == list(range(size))
    table = run("tasks", "show", "hazard_comm-10").stdout
    for block in shown["vectors"]["observation"]:
        assert block["name"] in table
        assert block["visible"] in table
    assert f"{env.observation_size} numbers" in table


def test_lists():
    listed = json.loads(run("tasks", "--json").stdout)
    assert [task["task"] for task in listed] == list(tasks())
    agents = {agent["name"]: agent for agent in json.loads(run("agents", "--json").stdout)}
    assert agents["random"]["builtin"] == "random"
    assert TASK in [task["task"] for task in agents["scripted"]["tasks"]]
    text = run("tasks").stdout
    for task, spec in tasks().items():
        assert task in text
        assert spec.summary in text
    assert run("agents", "show", "random").returncode == 0


def test_all_splits_come_to_lie_side_by_side_and_are_exported(tmp_path):
    done = run(
        "evaluate", "--agent", "random", "--tasks", TASK, "--episodes", 2, "--video", 0, "--split", "all",
        "--out", tmp_path / "all",
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    folders = sorted(path.name for path in (tmp_path / "all").iterdir())
    assert folders == ["ad_hoc", "forced_death", "shift", "standard"]
    for name in folders:
        row = json.loads((tmp_path / "all" / name / f"episodes/{TASK}.jsonl").read_text().splitlines()[0])
        assert row["split"] == name
        assert json.loads((tmp_path / "all" / name / "results.json").read_text())["split"] == name
    done = run("export", *sorted((tmp_path / "all").iterdir()), "--out", tmp_path / "out.json")
    assert done.returncode == 0, done.stderr
    assert set(json.loads((tmp_path / "out.json").read_text())) == {
        "hipg_bench", "hipg_bench_ad_hoc", "hipg_bench_forced_death", "hipg_bench_shift",
    }  # fmt: skip
    done = run("evaluate", "--agent", "random", "--split", "ad_hok", "--out", tmp_path / "no")
    assert (done.returncode, "did you mean 'ad_hoc'?" in done.stderr) == (2, True)
