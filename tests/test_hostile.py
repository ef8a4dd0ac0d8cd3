"""Agents that mean harm: none gains a score, harms the host or stops the run.

Each folder of ``tests/hostile`` holds one. All but the idle one act as the honest agent does, and something
besides; what finds, kills or reaches what it should not ends its own process, so that its status shows it.
"""

import gc
import hashlib
import json
import os
import shutil
import socket
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from foreign import TASK, WORKING, descendants, policy

from hipg_bench.evaluation.decentralised import verify
from hipg_bench.evaluation.episodes import EvaluationJob
from hipg_bench.evaluation.runner import Suite, evaluate
from hipg_bench.policies.bundle import load_agent
from hipg_bench.sandbox import choice
from hipg_bench.sandbox.budget import Budget

pytestmark = pytest.mark.skipif(not WORKING, reason="no sandbox works on this machine")
FOLDER = Path(__file__).parent / "hostile"
JOB = EvaluationJob(episodes=2, threads=1)
SHORT = Budget(start_up=30.0, soft=0.25, hard=1.5, bank=0.4, memory=256 << 20)
SALT = b"a salt of at least thirty-two bytes, for a test"

STATUS = {
    # what the first row says; the second is then not played, as one failure of two is a DNF
    "null": "wrong_shape",
    "nan": "not_finite",
    "sleeper": "timeout",
    "endless": "timeout",
    "crash_at_step": "crash",
    "memory_hog": "crash",
}
SAME_AS_HONEST = (
    "fork_bomb", "file_walker", "socket_opener", "parent_killer", "observation_writer", "flooder",
    "answers_for_the_dead", "salt_finder",
)  # fmt: skip
DANGEROUS = ("fork_bomb", "memory_hog", "file_walker", "socket_opener", "parent_killer", "salt_finder")
"""What only a sandbox stops: tried in each."""
ANYWHERE = [(name, sandbox) for name in DANGEROUS for sandbox in WORKING]
ANYWHERE += [(name, WORKING[0]) for name in (*STATUS, *SAME_AS_HONEST) if WORKING and name not in DANGEROUS]


@pytest.fixture(scope="module")
def honest(tmp_path_factory):
    """Rows of the honest agent in the same two worlds."""
    rows = JOB.play_all(TASK, _agent("honest", tmp_path_factory.mktemp("honest"), {}))
    assert [row["status"] for row in rows] == ["ok", "ok"]
    assert np.mean([row["score"] for row in rows]) > 0.3  # there is something to lose
    return rows


@pytest.fixture
def scene(tmp_path, monkeypatch):
    """What an attacker would like to reach, and a check afterwards that none did."""
    secret, folder = tmp_path / "salt", tmp_path / "agent"
    secret.write_bytes(SALT)
    folder.mkdir()
    monkeypatch.setenv("HIPG_SALT", SALT.decode())
    victim = subprocess.Popen([sys.executable, "-I", "-S", "-c", "import time; time.sleep(600)"])
    tcp, udp = socket.create_server(("127.0.0.1", 0)), socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    udp.bind(("127.0.0.1", 0))
    tcp.setblocking(False)
    udp.setblocking(False)
    before = set(descendants(os.getpid()))
    yield folder, {
        "secret": str(secret), "folder": str(tmp_path), "parent": os.getpid(), "victim": victim.pid,
        "tcp": tcp.getsockname()[1], "udp": udp.getsockname()[1],
        "commitment": hashlib.sha256(SALT).hexdigest(),
    }  # fmt: skip
    with pytest.raises(BlockingIOError):
        tcp.accept()
    with pytest.raises(BlockingIOError):
        udp.recv(1)
    tcp.close()
    udp.close()
    assert victim.poll() is None
    gc.collect()  # a failure's traceback holds the policy, and with it the child that would have been next
    deadline = time.monotonic() + 5.0
    while not before.issuperset(descendants(os.getpid())) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert before.issuperset(descendants(os.getpid()))  # no stray processes
    victim.kill()
    victim.wait()
    assert secret.read_bytes() == SALT
    assert {path.name for path in tmp_path.iterdir()} == {"salt", "agent"}
    assert not list(Path("/").glob("written-by-an-agent"))


def _agent(name, folder, targets, budget=SHORT):
    """The agent of that name, beside the honest one that it imports."""
    shutil.copy(FOLDER / "honest" / "agent.py", folder / "honest.py")
    shutil.copy(FOLDER / name / "agent.py", folder / "agent.py")
    (folder / "targets.json").write_text(json.dumps(targets))
    return policy(folder, budget=budget)


@pytest.mark.parametrize(("name", "sandbox"), ANYWHERE)
def test_a_hostile_agent_gains_nothing_and_harms_nobody(scene, honest, monkeypatch, name, sandbox):
    monkeypatch.setattr(choice, "BACKENDS", {sandbox: choice.BACKENDS[sandbox]})
    rows = JOB.play_all(TASK, _agent(name, *scene))
    if name in SAME_AS_HONEST:
        assert rows == honest
        return
    assert [row["status"] for row in rows] == [STATUS[name], "not_played"]
    assert rows[0]["return"] <= min(honest[0]["return"], TASK.anchors.random.mean)
    assert rows[1]["return"] == TASK.floor


def test_without_a_sandbox_the_salt_would_be_found(scene):
    """The attacker is able: it is the sandbox that stops it."""
    folder, targets = scene
    _agent("salt_finder", folder, targets)
    rows = JOB.play_all(TASK, policy(folder, trust=True))
    assert [row["status"] for row in rows] == ["crash", "not_played"]


def test_an_idle_agent_plays_and_scores_less(scene, honest):
    rows = JOB.play_all(TASK, _agent("idle", *scene))
    assert [row["status"] for row in rows] == ["ok", "ok"]
    assert all(row["score"] < other["score"] for row, other in zip(rows, honest, strict=True))


def test_an_agent_that_shares_is_listed_as_centralised(scene, honest):
    agent = _agent("sharer", *scene)
    assert [row["status"] for row in JOB.play_all(TASK, agent)] == ["ok", "ok"]
    short = TASK.override(horizon=10)
    verdict = verify(short, agent, JOB, [0, 1])
    assert not verdict.decentralised
    told = {difference.agent for difference in verdict.differences}
    assert told == {1, 2, 3}  # it is the first one that the others hear of
    assert verify(short, _agent("honest", *scene), JOB, [0, 1]).decentralised


def test_every_folder_is_played():
    names = {path.name for path in FOLDER.iterdir() if path.is_dir()}
    assert names == {"honest", "idle", "sharer", *STATUS, *SAME_AS_HONEST}


def test_a_run_goes_on_after_an_agent_that_crashes(tmp_path, honest):
    """As a bundle, through the whole evaluation: a DNF at the floor, and the next agent plays."""
    results = {}
    for name in ("crash_at_step", "honest"):
        folder = tmp_path / name
        folder.mkdir()
        _agent(name, folder, {})
        (folder / "agent.toml").write_text(
            f'name = "{name}"\nsummary = "for a test"\nkind = "python"\nentry_point = "agent:make_agent"\n'
            f"[tasks]\n{TASK.task} = [0]\n"
        )
        suite = Suite("one", (TASK,))
        results[name] = evaluate(load_agent(folder), suite, tmp_path / f"out-{name}", JOB)
    (crashed,), (fine,) = (results[name]["tasks"] for name in ("crash_at_step", "honest"))
    assert crashed["dnf"]
    assert not fine["dnf"]
    lines = (tmp_path / "out-honest" / "episodes" / f"{TASK.task}.jsonl").read_text().splitlines()
    assert [json.loads(line)["return"] for line in lines] == [row["return"] for row in honest]
