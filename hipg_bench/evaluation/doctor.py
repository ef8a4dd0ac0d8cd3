"""What is wrong with this machine or installation, found by trying; and the line that fixes it."""

from __future__ import annotations

import importlib.metadata
import os
import platform
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Literal, NamedTuple

from packaging.requirements import Requirement
from packaging.version import Version

from hipg_bench import processes
from hipg_bench.evaluation import machines
from hipg_bench.rendering import gl
from hipg_bench.sandbox import choice

Level = Literal["ok", "note", "warning", "broken"]
"""``warning``: something does not work, but scores do. ``broken``: nothing will work."""


class Finding(NamedTuple):
    """What one look found.

    Attributes:
        name: what was looked at.
        level: how bad it is.
        text: what was found.
        fix: the line to run, empty where nothing is wrong.
    """

    name: str
    level: Level
    text: str
    fix: str = ""


_PACKAGE = "hipg-bench"
_SPARE_DISK = 2e9
"""Bytes below which an evaluation with films may not fit."""
_SLOW = 2_000
"""Environment steps per second below which an evaluation takes long."""
_SPEED_TASK, _SPEED_ENVS, _SPEED_SECONDS = "hazard_nav-4", 256, 1.0
_SANDBOX_MENDS = {"bubblewrap": "apt install bubblewrap"}
_GL_NAMES = ("egl", "osmesa", "glfw", "")


def examine(told: Callable[[Finding], None] = lambda finding: None) -> list[Finding]:
    """Look at everything; ``told`` hears of each finding at once."""
    findings: list[Finding] = []
    for look in (
        _python,
        _packages,
        _gl_variables,
        _graphics,
        _encoder,
        _display,
        _rows,
        _cores,
        _disk,
        _data,
        _sandbox,
        _speed,
    ):
        for finding in look():
            findings.append(finding)
            told(finding)
    return findings


def healthy(findings: list[Finding]) -> bool:
    """Whether agents can be scored here."""
    return all(finding.level != "broken" for finding in findings)


def as_json(findings: list[Finding]) -> dict[str, Any]:
    """For a script."""
    return {"ok": healthy(findings), "findings": [finding._asdict() for finding in findings]}


def _python() -> Iterator[Finding]:
    version = platform.python_version()
    text = f"{version} at {sys.executable}, {platform.platform()}"
    yield Finding("python", "ok", text)


def _rows() -> Iterator[Finding]:
    differs = machines.why_rows_may_differ()
    if differs:
        yield Finding("rows", "note", f"{differs}; scores are the same within their intervals")
    else:
        yield Finding("rows", "ok", f"equal to those of other machines ({machines.PROMISE})")


def _packages() -> Iterator[Finding]:
    """Every dependency against the range that the package asks for."""
    try:
        wanted = importlib.metadata.requires(_PACKAGE) or []
        yield Finding(_PACKAGE, "ok", importlib.metadata.version(_PACKAGE))
    except importlib.metadata.PackageNotFoundError:
        yield Finding(
            _PACKAGE, "broken", "not installed in this Python", f"{sys.executable} -m pip install -e ."
        )
        return
    for line in wanted:
        requirement = Requirement(line)
        if requirement.marker is None or requirement.marker.evaluate({"extra": ""}):
            yield _package(requirement)


def _package(requirement: Requirement) -> Finding:
    name = requirement.name
    fix = f"{sys.executable} -m pip install '{name}{requirement.specifier}'"
    try:
        version = importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return Finding(name, "broken", "missing", fix)
    if requirement.specifier.contains(version, prereleases=True):
        return Finding(name, "ok", version)
    why = f"{version}, but {requirement.specifier} is needed"
    if name == "mujoco" and Version(version) >= Version("4"):
        why += ": dm-control 1.0.50 does not work with mujoco 4 (flex_vertedge)"
    return Finding(name, "broken", why, fix)


def _gl_variables() -> Iterator[Finding]:
    """Environment variables that stop MuJoCo from being imported."""
    chosen, platform_name = (
        os.environ.get("MUJOCO_GL", "").lower(),
        os.environ.get("PYOPENGL_PLATFORM", "").lower(),
    )
    if chosen not in gl.NAMES:
        yield Finding(
            "MUJOCO_GL", "broken", f"{chosen!r} is no backend: mujoco refuses to start", "unset MUJOCO_GL"
        )
    elif platform_name and chosen in gl.BACKENDS and platform_name != chosen:
        text = f"MUJOCO_GL={chosen} and PYOPENGL_PLATFORM={platform_name} contradict each other"
        yield Finding("PYOPENGL_PLATFORM", "broken", text, "unset PYOPENGL_PLATFORM")
    elif chosen:
        yield Finding("MUJOCO_GL", "note", f"set to {chosen}")


def _graphics() -> Iterator[Finding]:
    """Each backend by rendering a frame in a child process."""
    probes = [gl.probe(backend) for backend in gl.BACKENDS]
    usable = any(probe.works for probe in probes)
    for probe in probes:
        name = f"GL {probe.backend}"
        if probe.works:
            yield Finding(name, "ok", f"a frame in {probe.seconds:.1f} s, {probe.renderer}")
        else:
            # one backend is enough
            yield Finding(name, "note" if usable else "warning", probe.error, gl.INSTALL_COMMAND)
    if not usable:
        yield Finding("films", "warning", "no OpenGL works: scores come without films", gl.INSTALL_COMMAND)


def _encoder() -> Iterator[Finding]:
    fix = f"{sys.executable} -m pip install --force-reinstall imageio-ffmpeg"
    try:
        import imageio_ffmpeg

        program = imageio_ffmpeg.get_ffmpeg_exe()
        said = subprocess.run(
            [program, "-version"], capture_output=True, text=True, timeout=30, check=True
        ).stdout
        listed = subprocess.run(
            [program, "-hide_banner", "-encoders"], capture_output=True, text=True, timeout=30, check=True
        ).stdout
    except (ImportError, RuntimeError, OSError, subprocess.SubprocessError) as error:
        yield Finding("ffmpeg", "warning", str(error), fix)
        return
    version = " ".join(said.split()[:3])
    if "libx264" in listed:
        yield Finding("ffmpeg", "ok", f"{version}, with libx264")
    else:
        yield Finding(
            "ffmpeg", "warning", f"{version} cannot write H.264", f"unset IMAGEIO_FFMPEG_EXE; {fix}"
        )


def _display() -> Iterator[Finding]:
    display = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    if display or not sys.platform.startswith("linux"):
        yield Finding("display", "ok", display or "of the desktop")
    else:
        yield Finding("display", "note", "none: `hipg-bench view` needs one, nothing else does")


def _cores() -> Iterator[Finding]:
    usable = processes.usable_cores()
    names = ("OMP_NUM_THREADS", "LP_NUM_THREADS", "MKL_NUM_THREADS")
    limits = ", ".join(f"{name}={os.environ[name]}" for name in names if name in os.environ)
    text = f"{usable} of {os.cpu_count()} usable" + (f", {limits}" if limits else "")
    yield Finding("cores", "ok", f"{text}; physics runs on {usable} threads by default")


def _disk() -> Iterator[Finding]:
    here = Path.cwd()
    free = shutil.disk_usage(here).free
    text = f"{free / 1e9:.1f} GB free in {here}"
    if free < _SPARE_DISK:
        yield Finding(
            "disk",
            "warning",
            f"{text}; {_SPARE_DISK / 1e9:.0f} GB are comfortable",
            "hipg-bench evaluate --out FOLDER_ON_A_LARGER_DISK",
        )
    elif not os.access(here, os.W_OK):
        yield Finding(
            "disk", "warning", f"{here} is not writable", "hipg-bench evaluate --out FOLDER_THAT_IS"
        )
    else:
        yield Finding("disk", "ok", text)


def _data() -> Iterator[Finding]:
    """Task files and agent bundles."""
    try:
        from hipg_bench import registry
        from hipg_bench.policies import bundle

        yield Finding("tasks", "ok", f"{len(registry.tasks())} read")
        yield Finding("agents", "ok", ", ".join(bundle.agents()))
    except Exception as error:
        yield _failure("tasks", error)


def _sandbox() -> Iterator[Finding]:
    """What each way to lock agents of others in refuses, by trying."""
    results = choice.probe_all()
    works = any(result.works for result in results.values())
    for name, result in results.items():
        text = f"{result} ({result.seconds:.1f} s)"
        if result.works:
            yield Finding(f"sandbox {name}", "ok", text)
        else:
            level: Level = "note" if works else "warning"
            yield Finding(f"sandbox {name}", level, text, _SANDBOX_MENDS.get(name, ""))


def _speed() -> Iterator[Finding]:
    """Environment steps for a second, on all cores."""
    name = f"speed of {_SPEED_TASK}"
    try:
        import numpy as np

        from hipg_bench import registry

        env = registry.make(_SPEED_TASK, _SPEED_ENVS)
        env.reset()
        rng = np.random.default_rng(0)
        action = rng.uniform(-1, 1, (_SPEED_ENVS, env.num_agents, env.action_size))
        env.step(action)
        steps, start = 0, time.perf_counter()
        while (spent := time.perf_counter() - start) < _SPEED_SECONDS:
            env.step(action)
            steps += _SPEED_ENVS
    except Exception as error:
        yield _failure(name, error)
        return
    rate = steps / spent
    text = f"{rate:,.0f} env-steps/s with {_SPEED_ENVS} worlds"
    if rate < _SLOW:
        yield Finding(name, "warning", f"{text}: slow, is the machine busy?", "uptime")
    else:
        yield Finding(name, "ok", text)


def _failure(name: str, error: Exception) -> Finding:
    """Something essential raised."""
    text = f"{type(error).__name__}: {error}"
    for variable in ("MUJOCO_GL", "PYOPENGL_PLATFORM"):
        if variable in text:
            return Finding(name, "broken", text, f"unset {variable}")
    return Finding(name, "broken", text, f"{sys.executable} -m pip install --force-reinstall {_PACKAGE}")
