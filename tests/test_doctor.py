"""The doctor finds what is wrong, and names the line that fixes it."""

import importlib.metadata
import json
import os
import subprocess
import sys

from packaging.requirements import Requirement

from hipg_bench.evaluation import doctor
from hipg_bench.rendering import gl


def _doctor(*words, **environment):
    return subprocess.run(
        [sys.executable, "-c", "from hipg_bench.cli import main; main()", "doctor", *words],
        capture_output=True, text=True, timeout=120, env={**os.environ, **environment}, check=False,
    )  # fmt: skip


def test_json_holds_what_is_installed_and_what_renders():
    done = _doctor("--json")
    found = json.loads(done.stdout)
    by_name = {finding["name"]: finding for finding in found["findings"]}
    assert done.returncode == (0 if found["ok"] else 1)
    assert found["ok"] == all(finding["level"] != "broken" for finding in found["findings"])
    for package in ("mujoco", "dm-control", "numpy", "torch"):
        assert by_name[package]["text"].startswith(importlib.metadata.version(package))
    for backend in gl.BACKENDS:
        assert (by_name[f"GL {backend}"]["level"] == "ok") == gl.probe(backend).works
    rate = by_name["speed of hazard_nav-4"]["text"].split()[0].replace(",", "")
    assert float(rate) > 100
    assert {"python", "cores", "disk", "ffmpeg", "tasks", "agents", "display"} <= set(by_name)


def test_a_variable_that_stops_mujoco_is_named_and_the_exit_code_is_1():
    done = _doctor(MUJOCO_GL="nonsense")
    assert done.returncode == 1
    assert "unset MUJOCO_GL" in done.stdout
    assert "Traceback" not in done.stderr
    assert "pip install" not in done.stdout.partition("To fix it")[2]


def test_a_package_that_is_missing_or_of_a_wrong_version_gets_its_line():
    missing = doctor._package(Requirement("no-such-package-here>=2"))
    assert (missing.level, missing.text) == ("broken", "missing")
    assert missing.fix.endswith("-m pip install 'no-such-package-here>=2'")
    old = doctor._package(Requirement("numpy<1"))
    assert old.level == "broken"
    assert importlib.metadata.version("numpy") in old.text
    assert old.fix.endswith("'numpy<1'")
    assert doctor._package(Requirement("numpy>=2")).level == "ok"


def test_without_opengl_scores_still_work(monkeypatch):
    # a backend that mujoco does not know fails in its child just as a missing library does
    monkeypatch.setattr(gl, "BACKENDS", ("nonsense",))
    findings = list(doctor._graphics())
    assert [finding.level for finding in findings] == ["warning", "warning"]
    assert all(finding.fix == gl.INSTALL_COMMAND for finding in findings)
    assert doctor.healthy(findings)


def test_one_working_backend_is_enough(monkeypatch):
    working = gl.working_backend()
    if working is not None:
        monkeypatch.setattr(gl, "BACKENDS", ("nonsense", working))
        assert [finding.level for finding in doctor._graphics()] == ["note", "ok"]
