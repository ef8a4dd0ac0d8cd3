"""No process of ours imports, or takes settings, from the folder a user happens to work in."""

import ast
import os
import subprocess
import sys
from pathlib import Path

import pytest

import hipg_bench
from hipg_bench import processes

SOURCE = Path(hipg_bench.__file__).parent
PROGRAM = Path(sys.executable).with_name("hipg-bench")
NAMES = sorted(
    {
        *sys.stdlib_module_names,
        "numpy",
        "mujoco",
        "torch",
        "numba",
        "scipy",
        "OpenGL",
        "glfw",
        "imageio",
        "PIL",
    }
    | {"imageio_ffmpeg", "typer", "rich", "pydantic", "yaml", "matplotlib", "hipg_bench", "sitecustomize"}
)


@pytest.fixture
def trap(tmp_path):
    """A folder with a module for every name, each of which leaves a mark, and a bundle that is only data."""
    folder = tmp_path / "work"
    folder.mkdir()
    file = f"{str(tmp_path / 'mark')!r} + str(os.getpid())"
    mark = f"import os; os.close(os.open({file}, os.O_CREAT)); raise SystemExit(9)\n"
    for name in NAMES:
        (folder / f"{name}.py").write_text(mark)
    (folder / "numpy").mkdir()
    # numba would load machine code, which is pickled, from where its settings say
    (folder / ".numba_config.yaml").write_text(f"cache_dir: {folder}/cache\nopt: 9\n")
    (folder / "matplotlibrc").write_text("backend: module://random\n")
    (folder / "agent.toml").write_text(
        'name = "mine"\nsummary = "s"\nkind = "network"\nlicense = "MIT"\nauthors = "A"\n'
    )
    (folder / "README.md").write_text("# mine\n" * 50)
    (folder / "hazard_nav-4").mkdir()
    weights = Path("agents/mappo_minhealth/hazard_nav-4/seed0.safetensors")
    (folder / "hazard_nav-4" / "seed0.safetensors").write_bytes(weights.read_bytes())
    return folder


def run(trap, *command):
    plain = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
    done = subprocess.run(command, cwd=trap, env=plain, capture_output=True, text=True)
    assert not list(trap.parent.glob("mark*")), f"{command} imported from the working folder"
    return done


@pytest.mark.parametrize(
    "command",
    [
        "submit check .",
        "evaluate --agent . --tasks hazard_nav-4 --episodes 1 --video 1 --out {out}",
        "video --agent . --task hazard_nav-4 --width 64 --height 64 --out {out}/one.gif",
        "doctor",
        "train --sweep {sweep} --out {out}",
        "tasks",
    ],
    ids=lambda command: command.split()[0],
)
def test_nothing_is_imported_from_the_working_folder(trap, tmp_path, command):
    sweep = tmp_path / "sweep.toml"
    settings = "{ steps = 8, num_envs = 2, rollout = 4, eval_every = 0 }"
    sweep.write_text(
        f'[[run]]\ntasks = ["hazard_nav-4"]\nalgorithms = ["central"]\nseeds = [0]\nsettings = {settings}\n'
    )
    done = run(trap, str(PROGRAM), *command.format(out=tmp_path / "out", sweep=sweep).split())
    assert "Traceback" not in done.stderr, done.stderr[-2000:]
    assert not (trap / "cache").exists()
    if command.startswith(("evaluate", "video", "train", "tasks")):
        assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]


def test_a_script_of_the_users_renders_where_files_shadow_modules(trap, tmp_path):
    """The script's own folder is on its path, the working folder is not; nor on the child's that draws."""
    script = tmp_path / "script" / "go.py"
    script.parent.mkdir()
    script.write_text(
        "import hipg_bench\n"
        "env = hipg_bench.parallel_env('hazard_nav-4', render_mode='rgb_array')\n"
        "env.reset(seed=1)\n"
        "print(env.render().shape)\n"
    )
    (trap / ".numba_config.yaml").unlink()  # a library leaves a user's settings of other libraries alone
    done = subprocess.run([sys.executable, str(script)], cwd=trap, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]
    assert not list(tmp_path.glob("mark*"))


def test_every_process_is_started_with_these_rules():
    """Who starts Python by name takes the command from `processes`; the sandbox has rules of its own."""
    own = [
        path for path in SOURCE.rglob("*.py") if "sandbox" not in path.parts and path.name != "processes.py"
    ]
    lists = [
        (path.name, node.lineno)
        for path in own
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.List) and node.elts and "sys.executable" in ast.unparse(node.elts[0])
    ]
    assert not lists


def test_relative_entries_of_pythonpath_are_not_handed_on(monkeypatch):
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(["", "relative", "/absolute"]))
    assert processes.environment()["PYTHONPATH"] == "/absolute"
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(["", "."]))
    assert "PYTHONPATH" not in processes.environment()
