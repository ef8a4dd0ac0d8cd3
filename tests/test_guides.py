"""The guides' commands and code, in the order in which they stand there."""

import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

DOCS = Path(__file__).parents[1] / "docs"


def blocks(page: str, language: str) -> list[str]:
    """The page's blocks of code in a language."""
    return re.findall(rf"```{language}\n(.*?)```", (DOCS / page).read_text(encoding="utf-8"), re.DOTALL)


def run_commands(page: str, language: str, folder: Path) -> str:
    """What all blocks of commands of a page print."""
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    done = subprocess.run(
        ["bash", "-euo", "pipefail", "-c", "\n".join(blocks(page, language))], cwd=folder, timeout=600,
        capture_output=True, text=True, check=False, env={**os.environ, "PATH": path, "OMP_NUM_THREADS": "1"},
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_a_task_of_ones_own(tmp_path, monkeypatch):
    said = run_commands("guides/own_task.md", "bash", tmp_path)
    assert "hazard sensitivity" in said
    assert "ranked on what all played: my_nav-5" in said
    assert (tmp_path / "mine.gif").read_bytes()[:3] == b"GIF"
    monkeypatch.chdir(tmp_path)
    shown: dict = {}
    exec(compile(blocks("guides/own_task.md", "python")[0], "own_task.md", "exec"), shown)
    assert shown["env"].num_agents == 5
    assert shown["milder"].spec.params["hazard_peak"] == 0.25
    assert shown["milder"].spec.weights["collision"] == -1.0


def test_getting_started_plays(capsys):
    (code,) = blocks("getting_started.md", "python")
    exec(compile(code, "getting_started.md", "exec"), {})
    shapes, results = capsys.readouterr().out.splitlines()
    # 64 worlds of 8 drones; health, velocity 3, position 3, 8 points x 5, 7 neighbours x 8
    assert shapes == "(64, 8, 103) (64,)"
    # anchor of random play in the task file: -30.3
    assert float(results.split()[1]) == pytest.approx(-30.3, abs=3)


def test_getting_started_goes_from_an_evaluation_to_a_comparison(tmp_path):
    said = run_commands("getting_started.md", "sh", tmp_path)
    assert said.count("ranked on what all played: hazard_nav-4") == 2
    assert (tmp_path / "film.gif").exists()


def test_a_learner_of_ones_own_learns(capsys):
    (code,) = blocks("guides/own_learner.md", "python")
    exec(compile(code, "own_learner.md", "exec"), {})
    # random actions: -41.6 in the task file
    assert float(capsys.readouterr().out.split()[-1]) > -39


def test_a_forked_world_lost_the_agent():
    (code,) = blocks("concepts/death.md", "python")
    shown: dict = {}
    exec(compile(code, "death.md", "exec"), shown)
    np.testing.assert_array_equal(shown["step"].info["alive"], [[True] * 4, [True, True, False, True]])


def test_the_family_shown_is_the_example_that_is_tested():
    (code,) = blocks("guides/own_family.md", "python")
    example = (DOCS.parent / "examples" / "careful_nav" / "careful_nav.py").read_text(encoding="utf-8")
    body = code.partition("class Terms")[2]
    assert body
    assert body.strip() in example
