"""Every example runs as a user runs it, some iterations long, and its learner learns."""

import dataclasses
import importlib.util
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

FOLDER = Path(__file__).parents[1] / "examples"


@dataclasses.dataclass(frozen=True)
class Run:
    """How an example is run here.

    Attributes:
        example: its file.
        options: that make it short.
        needs: the library without which it is skipped.
        gain: by how much its return rises at least, from the first three iterations to the last three.
    """

    example: str
    options: str = ""
    needs: str = "hipg_bench"
    gain: float = -np.inf


RUNS = (
    Run("pettingzoo_loop.py", "--episodes 3"),
    Run("careful_nav/try_it.py"),
    Run("cleanrl_ppo.py", "--iterations 12", gain=2.0),
    Run("sb3_ppo.py", "--iterations 12", "stable_baselines3", gain=2.0),
    Run("torchrl_mappo.py", "--iterations 12", "torchrl", gain=3.0),
    Run("rllib_ppo.py", "--iterations 2 --steps 500", "ray"),
    Run("benchmarl_maddpg.py", "--frames 2000", "benchmarl"),
    Run("benchmarl_qmix.py", "--frames 2000", "benchmarl"),
)

WINDOWS = {"dm_viewer.py"}
"""These open a window: they are run beside the tests of what they show."""

SUBMISSIONS = {"submit_sb3.py", "submit_cleanrl.py"}
"""`test_newcomer.py` runs these, as docs/guides/submit.md says."""


@pytest.mark.parametrize("run", RUNS, ids=lambda run: run.example)
def test_an_example_runs_and_its_learner_learns(run, tmp_path):
    if importlib.util.find_spec(run.needs) is None:
        pytest.skip(f"{run.needs} is not installed here")
    done = subprocess.run(
        [sys.executable, FOLDER / run.example, *run.options.split()],
        capture_output=True, text=True, check=False, cwd=tmp_path, timeout=500,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    returns = [float(number) for number in re.findall(r"return (-?\d+\.\d+)", done.stdout)]
    assert returns
    assert np.isfinite(returns).all()
    assert np.mean(returns[-3:]) - np.mean(returns[:3]) >= run.gain


def test_every_example_is_run_and_short():
    examples = {
        path.relative_to(FOLDER).as_posix(): path.read_text().splitlines()
        for path in [*FOLDER.glob("*.py"), *FOLDER.glob("*/try_it.py")]
    }
    assert set(examples) == {run.example for run in RUNS} | WINDOWS | SUBMISSIONS
    for name, lines in examples.items():
        assert len(lines) < 60, name


def test_the_viewer_without_a_display_says_so_in_a_line():
    environment = {name: value for name, value in os.environ.items() if "DISPLAY" not in name}
    done = subprocess.run(
        [sys.executable, "examples/dm_viewer.py"], cwd=Path(__file__).parents[1], env=environment,
        capture_output=True, text=True, timeout=120, check=False,
    )  # fmt: skip
    assert done.returncode == 1
    assert "there is no display" in done.stderr
    assert "Traceback" not in done.stderr
