"""The wheel alone: built here, put into an empty environment, run outside the checkout.

To save minutes the dependencies are not installed a second time: a ``.pth`` file lends the new
environment the packages of the one that runs these tests. The checkout's own editable install does not
come along (a ``.pth`` file inside a lent folder is not read), so ``hipg_bench`` is the wheel's.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import sysconfig
import venv
import zipfile
from pathlib import Path

import pytest

import hipg_bench

CHECKOUT = Path(__file__).resolve().parent.parent


def run(*command: str | Path, cwd: Path) -> str:
    """Standard output of a command that must succeed, run without this environment's variables."""
    env = {
        name: value for name, value in os.environ.items() if not name.startswith(("PYTHON", "VIRTUAL_ENV"))
    }
    done = subprocess.run([*map(str, command)], cwd=cwd, env=env, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("wheel")
    build = (sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", folder, CHECKOUT)
    run(*build, cwd=folder)
    (path,) = folder.glob("hipg_bench-*.whl")
    return path


@pytest.fixture(scope="module")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The ``bin`` folder of an environment that holds the wheel."""
    folder = tmp_path_factory.mktemp("environment")
    venv.create(folder)
    pip = (sys.executable, "-m", "pip", "--python", folder / "bin" / "python", "install", "-qq", "--no-deps")
    run(*pip, "--no-index", wheel, cwd=folder)
    (packages,) = (folder / "lib").glob("python*/site-packages")
    (packages / "lent.pth").write_text(sysconfig.get_path("purelib") + "\n")
    return folder / "bin"


def test_the_wheel_holds_the_data_and_nothing_at_top_level(wheel: Path):
    names = zipfile.ZipFile(wheel).namelist()
    tops = {name.split("/")[0] for name in names}
    assert tops == {"hipg_bench", f"hipg_bench-{hipg_bench.__version__}.dist-info"}
    for kind, pattern in (("assets", "*.xml"), ("tasks", "*.toml"), ("agents", "*/agent.toml")):
        files = [path.relative_to(CHECKOUT) for path in (CHECKOUT / kind).glob(pattern)]
        expected = {f"hipg_bench/data/{path}" for path in files}
        assert expected
        assert expected <= set(names)
    assert any(name.endswith("licenses/LICENSE") for name in names)


def test_it_is_the_wheel_that_runs(installed: Path, tmp_path: Path):
    script = "import hipg_bench, json; print(json.dumps([hipg_bench.__file__, sorted(hipg_bench.tasks())]))"
    place, tasks = json.loads(run(installed / "python", "-c", script, cwd=tmp_path))
    assert Path(place).is_relative_to(installed.parent)
    assert tasks == sorted(hipg_bench.tasks())
    agents = json.loads(run(installed / "hipg-bench", "agents", "--json", cwd=tmp_path))
    bundled = {path.parent.name for path in (CHECKOUT / "agents").glob("*/agent.toml")}
    assert bundled == {agent["name"] for agent in agents}


def test_an_evaluation_outside_the_checkout(installed: Path, tmp_path: Path):
    run(installed / "hipg-bench", "evaluate", "--agent", "random", "--quick", "--out", "scores", cwd=tmp_path)
    results = json.loads((tmp_path / "scores" / "results.json").read_text())
    assert [task["task"] for task in results["tasks"]] == sorted(hipg_bench.tagged("standard"))
    assert all(task["episodes"] == 32 for task in results["tasks"])
    assert (tmp_path / "scores" / "report.html").stat().st_size > 1000


def test_importing_is_light(installed: Path, tmp_path: Path):
    script = (
        "import hipg_bench, sys; hipg_bench.make('hazard_nav-4').reset(); "
        "print(sorted({'torch', 'gymnasium', 'pettingzoo', 'matplotlib'} & set(sys.modules)))"
    )
    assert run(installed / "python", "-c", script, cwd=tmp_path).strip() == "[]"
