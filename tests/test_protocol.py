"""Protocol 1: what is frozen is what is there; hidden worlds follow from the salt and are told to nobody."""

import hashlib
import hmac
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import hipg_bench
from hipg_bench import task_spec
from hipg_bench.errors import HipgError, ResumeError
from hipg_bench.evaluation import machines, protocol, runner, seeds, sources
from hipg_bench.evaluation.episodes import EvaluationJob
from hipg_bench.policies.bundle import load_agent
from hipg_bench.policies.simple import Random, Zero

SALT = bytes(range(32))
NAV = task_spec("hazard_nav-4").override(horizon=6)


def test_the_tree_is_the_frozen_suite():
    """Scores are comparable only on the same suite."""
    found = protocol.differences()
    assert not found, (
        f"the tree is no longer {protocol.SUITE}:\n  "
        + "\n  ".join(found)
        + "\nDid an episode change? Then old scores are not comparable: raise the task's version and the "
        "suite's (SUITE in evaluation/seeds.py), and measure its anchors again. If none did, and "
        "tests/test_golden.py says so too: `hipg-bench suite freeze`."
    )


def test_a_change_is_found_and_named(tmp_path, monkeypatch):
    text = protocol.path_of().read_text()
    spec = task_spec("hazard_nav-4")
    other = tmp_path / "hipg-1.toml"
    other.write_text(text.replace(spec.fingerprint, "0" * 12).replace("first_public_seed = 1000", ""))
    monkeypatch.setattr(protocol, "path_of", lambda suite="hipg-1": other)
    found = [line for line in protocol.differences() if not line.startswith("files")]
    assert found == [
        "protocol: first_public_seed was None, is 1000",
        f"tasks.hazard_nav-4: fingerprint was 000000000000, is {spec.fingerprint}",
    ]
    assert protocol.identity()["frozen"] is False
    protocol.freeze()
    assert protocol.differences() == []
    assert protocol.frozen() == protocol.facts()
    other.unlink()
    assert protocol.differences() == [f"{other} is missing"]


def test_what_decides_an_episode_is_in_the_file():
    files = protocol.frozen()["files"]
    for name in (
        "env.py",
        "engine.py",
        "mechanics/hazards.py",
        "families/hazard_nav.py",
        "evaluation/failures.py",
    ):
        assert f"hipg_bench/{name}" in files
    assert {"assets/walker.xml", "tasks/splits/shift.toml", "tasks/splits/walker.safetensors"} <= set(files)
    path = protocol.data_folder("assets") / "drone.xml"
    assert files["assets/drone.xml"] == hashlib.sha256(path.read_bytes()).hexdigest()[:16]


def test_what_is_loaded_to_play_is_frozen(tmp_path):
    """The files that Python itself loads while agents of all kinds play, against what is found by reading."""
    code = (
        "import sys\nfrom pathlib import Path\n"
        "from hipg_bench import task_spec\nfrom hipg_bench.evaluation import runner\n"
        "from hipg_bench.evaluation.episodes import EvaluationJob\n"
        "from hipg_bench.evaluation import results\n"
        "from hipg_bench.policies.network import load_network\nfrom hipg_bench.paths import data_folder\n"
        "for task in ('hazard_nav-4', 'multiwalker-3', 'paper_comm-10'):\n"
        "    path = data_folder('agents') / 'mappo_minhealth' / task / 'seed0.safetensors'\n"
        "    for split in ('standard', 'ad_hoc') if task[0] != 'p' else ('standard',):\n"
        "        spec = task_spec(task).override(horizon=3)\n"
        "        job = EvaluationJob(episodes=1, threads=1, split=split)\n"
        "        rows = job.play_all(spec, load_network(path))\n"
        "print(*sorted(str(m.__file__) for n, m in sys.modules.items() if n.startswith('hipg_bench')))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=300
    )
    package = Path(hipg_bench.__file__).parent
    loaded = {Path(name).relative_to(package) for name in done.stdout.split()}
    frozen = set(sources.files())
    assert Path("policies/attention.py") in frozen
    # the runner is loaded by this test alone: what it adds decides no row
    assert {
        str(path) for path in loaded - frozen if path.parts[0] in ("families", "mechanics", "policies")
    } <= {f"policies/{name}.py" for name in ("__init__", "bundle", "card", "foreign", "graph", "simple")}
    assert {Path("env.py"), Path("sim.py"), Path("native.py"), Path("layout.py")} <= loaded & frozen


def test_where_rows_are_equal(tmp_path, monkeypatch):
    cpuinfo = tmp_path / "cpuinfo"
    cpuinfo.write_text("processor : 0\nflags : fpu sse2 avx fma avx2\n")
    monkeypatch.setattr(machines.platform, "machine", lambda: "x86_64")
    monkeypatch.setattr(machines.platform, "libc_ver", lambda: ("glibc", "2.36"))
    monkeypatch.setattr(machines, "rounds_otherwise", lambda: [])
    assert machines.why_rows_may_differ(cpuinfo) is None
    cpuinfo.write_text("processor : 0\nflags : fpu sse2 avx\n")
    assert "no FMA instructions" in machines.why_rows_may_differ(cpuinfo)
    monkeypatch.setattr(machines.platform, "libc_ver", lambda: ("", ""))
    assert "C library" in machines.why_rows_may_differ(cpuinfo)
    monkeypatch.setattr(machines.platform, "machine", lambda: "aarch64")
    assert "aarch64" in machines.why_rows_may_differ(cpuinfo)


def test_a_processor_with_fma_that_does_not_use_it_is_noticed(monkeypatch):
    """GLIBC_TUNABLES takes FMA from the C library, and the processor's flags do not show it."""
    with monkeypatch.context() as by_flags_only:
        by_flags_only.setattr(machines, "rounds_otherwise", lambda: [])
        differs = machines.why_rows_may_differ()
    if differs:
        pytest.skip(differs)
    assert machines.rounds_otherwise() == []
    code = "from hipg_bench.evaluation import machines; print(machines.why_rows_may_differ())"
    said = {}
    for tunables in ("", "glibc.cpu.hwcaps=-FMA,-FMA4"):
        done = subprocess.run(
            [sys.executable, "-c", code],
            env={**os.environ, "GLIBC_TUNABLES": tunables},
            capture_output=True, text=True, check=True, timeout=60,
        )  # fmt: skip
        said[tunables] = done.stdout.strip()
    assert said.pop("") == "None"
    (refusal,) = said.values()
    assert {"sin", "cos", "exp", "log1p"} <= set(re.split(r",? ", refusal))
    assert "-FMA,-FMA4" in refusal


def test_hidden_seeds_are_an_hmac():
    message = b"hipg-1|shift|hazard_nav-4|3"
    digest = hmac.new(SALT, message, hashlib.sha256).hexdigest()
    # the first 63 bits: 16 hex digits are 64
    assert seeds.hidden_seed(SALT, "shift", "hazard_nav-4", 3) == int(digest[:16], 16) // 2
    assert seeds.commitment(SALT) == hashlib.sha256(SALT).hexdigest()
    with pytest.raises(HipgError, match="at least 16 bytes, got 15"):
        seeds.hidden_seed(SALT[:15], "shift", "hazard_nav-4", 3)
    drawn = {
        seeds.hidden_seed(salt, split, task, block)
        for salt in (SALT, SALT[1:])
        for split in ("standard", "shift")
        for task in ("hazard_nav-4", "hazard_nav-8")
        for block in range(5)
    }
    assert len(drawn) == 40


def test_public_worlds_are_numbered_and_apart_from_training():
    job = EvaluationJob()
    assert [job.eval_seed("any", world) for world in (0, 63, 64, 319)] == [1000, 1000, 1001, 1004]


def test_a_row_of_a_hidden_world_does_not_tell_its_seed():
    hidden, public = EvaluationJob(episodes=2, threads=1, salt=SALT), EvaluationJob(episodes=2, threads=1)
    rows = hidden.play_all(NAV, Random(3))
    secret = str(hidden.eval_seed(NAV.task, 0))
    assert secret not in json.dumps(rows)
    assert SALT.hex() not in repr(hidden)
    assert repr(SALT) not in repr(hidden)
    assert [row["eval_seed"] for row in rows] == [None, None]
    assert [row["return"] for row in rows] != [row["return"] for row in public.play_all(NAV, Random(3))]
    # who has the salt can play them again
    assert json.dumps(hidden.play_all(NAV, Random(3))) == json.dumps(rows)
    assert len(hidden.record(NAV, Random(3), rows[1])) == 7


@pytest.mark.parametrize("salt", [None, SALT])
def test_all_agents_meet_the_same_worlds(salt):
    job = EvaluationJob(episodes=2, threads=1, salt=salt)
    starts = []
    for policy in (Random(3), Zero(3)):
        rows = job.play_all(NAV, policy)
        starts.append([job.record(NAV, policy, row)[0] for row in rows])
    # toughness, which decides who survives what, is part of the row
    np.testing.assert_array_equal(*starts)


def test_a_hidden_evaluation_publishes_the_commitment_only(tmp_path):
    suite, agent = runner.Suite("custom", (NAV,)), load_agent("zero")
    job = EvaluationJob(episodes=3, threads=1, salt=SALT)
    results = runner.evaluate(agent, suite, tmp_path, job)
    assert (results["seed"], results["commitment"]) == (None, seeds.commitment(SALT))
    secret = str(job.eval_seed(NAV.task, 0))
    for path in tmp_path.rglob("*"):
        if path.is_file():
            assert secret not in path.read_text()
            assert SALT.hex() not in path.read_text()
    # resumed with the same salt only
    runner.evaluate(agent, suite, tmp_path, job)
    with pytest.raises(ResumeError, match="commitment"):
        runner.evaluate(agent, suite, tmp_path, EvaluationJob(episodes=3, threads=1, salt=SALT[1:]))
    with pytest.raises(ResumeError, match="seed"):
        runner.evaluate(agent, suite, tmp_path, EvaluationJob(episodes=3, threads=1))


def test_results_say_which_suite_they_are_of(tmp_path):
    suite = runner.Suite("custom", (NAV,))
    results = runner.evaluate(load_agent("zero"), suite, tmp_path, EvaluationJob(episodes=3, threads=1))
    assert results["protocol"] == protocol.identity()
    assert results["protocol"]["suite"] == "hipg-1"
    assert (results["schema"], results["split"], results["kind"]) == (2, "standard", "reference")
