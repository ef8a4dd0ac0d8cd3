"""A family from outside, `examples/careful_nav`, installed as a package, goes wherever ours go."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import hipg_bench
from hipg_bench.errors import SpecError
from hipg_bench.families import hazard_nav, known

EXAMPLE = Path(__file__).parents[1] / "examples" / "careful_nav"


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The package, installed into a folder of its own, and its task file."""
    folder = tmp_path_factory.mktemp("plugin")
    source = shutil.copytree(EXAMPLE, folder / "source")
    subprocess.run(
        [sys.executable, "-m", "pip", "install", "-q", "--no-deps", "--no-build-isolation", "--no-index",
         "--disable-pip-version-check", "--target", folder / "site", source],
        check=True, cwd=folder,
    )  # fmt: skip
    return folder


def command(installed: Path, *arguments: str) -> str:
    """Run hipg-bench in the plug-in's folder, as a user who installed the plug-in does."""
    done = subprocess.run(
        [sys.executable, "-P", "-m", "hipg_bench", *arguments],
        capture_output=True, text=True, check=False, cwd=installed, timeout=300,
        env={**os.environ, "PYTHONPATH": str(installed / "site"), "COLUMNS": "200"},
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_a_family_from_outside_is_trained_evaluated_filmed_and_calibrated(installed: Path) -> None:
    task, run = str(EXAMPLE / "careful_nav-5.toml"), str(installed / "run")
    command(installed, "train", "--task", task, "--steps", "4000", "--set", "num_envs=16", "--out", run)
    out = str(installed / "scores")
    command(
        installed, "evaluate", "--agent", run, "--task", task, "--episodes", "8", "--video", "1", "--out", out
    )
    assert list((installed / "scores").glob("**/*.gif")) + list((installed / "scores").glob("**/*.mp4"))
    assert (installed / "scores" / "results.json").is_file()
    film = installed / "film.gif"
    command(
        installed, "video", "--agent", "scripted", "--task", task, "--out", str(film),
        "--width", "160", "--height", "96", "--fps", "5",
    )  # fmt: skip
    assert film.stat().st_size > 1000
    told = json.loads(command(installed, "calibrate", task, "--episodes", "16", "--json"))
    assert "reference" in json.dumps(told)


def test_the_standard_suite_stays_frozen_beside_a_family_from_outside(installed: Path) -> None:
    assert "careful_nav" not in command(installed, "suite", "check")


def test_what_a_family_does_not_declare_it_has_from_its_parent(monkeypatch: pytest.MonkeyPatch) -> None:
    """Lost drones are charged, by the definition of the term; all else is hazard navigation's."""
    monkeypatch.setattr(known, "_registered", {})
    monkeypatch.syspath_prepend(EXAMPLE)
    import careful_nav

    hipg_bench.register_family("careful_nav", careful_nav)
    spec = hipg_bench.read_task(EXAMPLE / "careful_nav-5.toml")
    env = hipg_bench.make(spec, 8, compiled=False, hazard_radius=1.0, hazard_peak=0.9)
    step, died = env.reset(), 0
    for _ in range(12):
        alive = step.info["alive"]
        step = env.step(np.ones((8, 5, 3)))
        lost = (alive & ~step.info["final_alive"]).sum(axis=1)
        np.testing.assert_array_equal(step.info["terms"]["lost"], -5.0 * lost)
        died += int(lost.sum())
    assert died > 0
    assert known.lineage("careful_nav") == ("careful_nav", "hazard_nav")
    assert known.declared("careful_nav", "RENDERING") is known.declared("hazard_nav", "RENDERING")


def test_names_of_families_are_taken_once() -> None:
    with pytest.raises(SpecError, match="another family 'hazard_nav'"):
        hipg_bench.register_family("hazard_nav", hazard_nav)


def test_a_module_that_is_no_family_is_refused_with_what_it_lacks() -> None:
    with pytest.raises(SpecError, match=r"'nothing' \(json\) lacks .*Params.*begin"):
        hipg_bench.register_family("nothing", json)


def plugged(folder: Path, *arguments: str, code: int = 0) -> str:
    """What hipg-bench says in a folder where nothing is installed."""
    done = subprocess.run(
        [sys.executable, "-P", "-m", "hipg_bench", *arguments],
        capture_output=True, text=True, check=False, cwd=folder, timeout=300,
        env={**os.environ, "COLUMNS": "200", "OMP_NUM_THREADS": "1"},
    )  # fmt: skip
    assert done.returncode == code, done.stdout + done.stderr
    return done.stdout if code == 0 else done.stderr


def test_a_file_beside_the_task_is_a_plug_in_for_one_command_and_its_child_processes(tmp_path: Path) -> None:
    for name in ("careful_nav.py", "careful_nav-5.toml"):
        shutil.copy(EXAMPLE / name, tmp_path)
    task, plugin = "careful_nav-5.toml", ("--plugin", "careful_nav.py")
    assert "--plugin MODULE" in plugged(tmp_path, "tasks", "show", task, code=2)
    assert "weights.lost" in plugged(tmp_path, "tasks", "show", task, *plugin)
    said = plugged(
        tmp_path, "train", "--task", task, "--steps", "1024", "--set", "num_envs=16", "--out", "run", *plugin
    )
    assert "hipg-bench evaluate --agent run --task careful_nav-5.toml --plugin careful_nav.py\n" in said
    assert "hipg-bench calibrate careful_nav-5.toml --plugin careful_nav.py --write" in said
    assert "--plugin careful_nav.py" in json.loads((tmp_path / "run" / "train.json").read_text())["command"]
    # the film is drawn in a child process
    video = ("--width", "160", "--height", "96", "--fps", "5", "--out", "film.gif")
    plugged(tmp_path, "video", "--agent", "run", "--task", task, *video, *plugin)
    assert (tmp_path / "film.gif").stat().st_size > 1000
    told = json.loads(plugged(tmp_path, "calibrate", task, "--episodes", "8", "--json", *plugin))
    assert told["anchors"]["reference"]["mean"] > told["anchors"]["random"]["mean"]


def test_workers_of_a_sweep_know_a_plug_in_and_the_tasks_that_it_adds(tmp_path: Path) -> None:
    text = (EXAMPLE / "careful_nav.py").read_text(encoding="utf-8")
    text += (
        "\n\nimport sys\nimport hipg_bench\n"
        "hipg_bench.register_family('careful_nav', sys.modules[__name__])\n"
        f"hipg_bench.read_task({str(EXAMPLE / 'careful_nav-5.toml')!r})\n"
    )
    (tmp_path / "careful_nav.py").write_text(text, encoding="utf-8")
    (tmp_path / "sweep.toml").write_text(
        '[[run]]\ntasks = ["careful_nav-5"]\nseeds = [0]\n'
        "settings = { steps = 256, num_envs = 8, rollout = 8 }\n"
    )
    plugged(tmp_path, "train", "--sweep", "sweep.toml", "--out", "s", "--plugin", "careful_nav.py")
    assert (tmp_path / "s/careful_nav-5/min_health/seed0/policy.safetensors").is_file()


@pytest.mark.parametrize(
    ("name", "text", "says"),
    [
        ("absent.py", None, "there is no such file"),
        ("absent_module", None, "no such module is installed; a file is named by its path"),
        ("random.py", "", "'random' is the name of another module: rename the file"),
        ("raises.py", "1 / 0", "ZeroDivisionError: division by zero"),
        ("needs.py", "import absent_library", "No module named 'absent_library'"),
        ("no_family.py", "x = 1", "family 'no_family' (no_family) lacks"),
    ],
)
def test_plug_ins_that_cannot_be_used_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, text: str | None, says: str
) -> None:
    monkeypatch.delenv(known.PLUGINS, raising=False)
    if text is not None:
        (tmp_path / name).write_text(text, encoding="utf-8")
    with pytest.raises(SpecError, match=re.escape(says)):
        known.add_plugin(str(tmp_path / name) if name.endswith(".py") else name)
    assert known.PLUGINS not in os.environ
