"""docs/guides/submit.md, command by command: a newcomer trains and packs, a maintainer adds and verifies."""

import os
import re
import subprocess
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest

from hipg_bench import task_spec
from hipg_bench.policies.bundle import load_agent
from hipg_bench.policies.graph import check_graph
from hipg_bench.policies.network import GRUSpec, load_network
from hipg_bench.submissions.archive import unpack

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "docs" / "guides" / "submit.md").read_text(encoding="utf-8")
COMMANDS = re.findall(r"```bash\n(.*?)```", PAGE, re.DOTALL)
CODE = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)


@pytest.fixture(scope="module")
def desk(tmp_path_factory):
    """A newcomer's folder, with the repository's examples in it, after every command of the page."""
    for needed in ("stable_baselines3", "gymnasium"):
        pytest.importorskip(needed)
    folder = tmp_path_factory.mktemp("newcomer")
    (folder / "examples").symlink_to(ROOT / "examples")
    return folder, run_in_a_checkout(folder, COMMANDS, tmp_path_factory.mktemp("home"))


def run_in_a_checkout(folder, blocks, home):
    """What blocks of commands print, one after the other, in a folder under version control."""
    (folder / ".git").mkdir()
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    said = []
    for block in blocks:
        done = subprocess.run(
            ["bash", "-euo", "pipefail", "-c", block], cwd=folder, timeout=600,
            capture_output=True, text=True, check=False,
            env={**os.environ, "PATH": path, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1",
                 "HOME": str(home)},
        )  # fmt: skip
        assert done.returncode == 0, f"{block}\n{done.stdout}\n{done.stderr}"
        said.append(done.stdout)
    return said


def test_the_guide_leads_from_a_training_to_a_verified_entry(tmp_path):
    page = (ROOT / "docs" / "guides" / "leaderboard.md").read_text(encoding="utf-8")
    (block,) = re.findall(r"## Enter the leaderboard\n```sh\n(.*?)```", page, re.DOTALL)
    (checkout := tmp_path / "checkout").mkdir()
    (home := tmp_path / "home").mkdir()
    (said,) = run_in_a_checkout(checkout, [block], home)
    assert "my_agent: verified, decentralised" in said
    assert "my_agent" in (checkout / "site" / "index.html").read_text(encoding="utf-8")


def test_the_page_goes_the_whole_way():
    text = "".join(COMMANDS)
    for command in ("submit init", "submit check", "submit pack", "leaderboard add", "leaderboard verify"):
        assert f"hipg-bench {command}" in text


@pytest.mark.parametrize(
    ("name", "task", "tier"), [("sb3_ppo", "hazard_nav-4", 0), ("cleanrl_ppo", "coop_nav-3", 2)]
)
def test_what_a_newcomer_packs_plays(desk, tmp_path, name, task, tier):
    unpack(desk[0] / f"{name}.zip", tmp_path / name)
    agent = load_agent(tmp_path / name)
    assert (agent.card.tier, agent.tasks, agent.card.authors) == (tier, (task,), "Ada Lovelace")
    spec = task_spec(task)
    policy = agent.policy(spec)
    seen = np.random.default_rng(0).normal(
        size=(2, spec.num_agents, {"hazard_nav-4": 51, "coop_nav-3": 38}[task])
    )
    alive = np.ones((2, spec.num_agents), bool)
    action, _ = policy.act(
        seen.astype(np.float32), policy.initial_state(0, np.arange(2), spec.num_agents), alive
    )
    assert action.shape == (2, spec.num_agents, 3)
    assert action.std() > 0.01


def test_a_maintainer_verifies_both(desk):
    said = desk[1][-1]
    assert "sb3_ppo: verified, decentralised, sandbox not needed" in said
    assert "cleanrl_ppo: verified, centralised, sandbox bubblewrap" in said
    page = (desk[0] / "site" / "index.html").read_text(encoding="utf-8")
    assert "sb3_ppo" in page
    assert "cleanrl_ppo" in page


def test_what_the_page_exports_can_be_read(tmp_path, monkeypatch):
    pytest.importorskip("onnx")
    monkeypatch.chdir(tmp_path)
    shown: dict[str, object] = {}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for block in CODE:
            exec(compile(block, "docs/guides/submit.md", "exec"), shown)
    networks = {
        name: load_network(tmp_path / f"{name}_agent/hazard_nav-4/seed0.safetensors")
        for name in ("mlp", "gru", "attention")
    }
    assert {(one.observation_size, one.action_size) for one in networks.values()} == {(51, 3)}
    assert isinstance(networks["gru"].spec, GRUSpec)
    check_graph(tmp_path / "onnx_agent.onnx", task_spec("hazard_nav-4"))
