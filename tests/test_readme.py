"""What the README shows works as shown."""

import importlib.util
import re
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

README = Path(__file__).parent.parent / "README.md"
BLOCKS = re.findall(r"```python\n(.*?)```", README.read_text(encoding="utf-8"), re.DOTALL)
ADAPTERS = {
    "PettingZoo": "pettingzoo",
    "Gymnasium": "gymnasium",
    "dm_control": "dm_control",
    "TorchRL": "torchrl",
    "Stable-Baselines3": "stable_baselines3",
    "RLlib": "ray",
    "BenchMARL": "benchmarl",
}
"""How a block on an adapter begins, and the library it needs."""


def block_on(adapter: str) -> str:
    (code,) = [block for block in BLOCKS if re.match(rf"# {adapter}\b", block)]
    return code


def test_the_python_example_runs_and_prints_a_return_and_deaths(capsys) -> None:
    (code,) = [block for block in BLOCKS if not block.startswith("# ")]
    exec(compile(code, README, "exec"), {})
    episode_return, deaths = map(float, capsys.readouterr().out.split())
    # anchor of random play in the task file: -30.3; 64 episodes with a deviation of about 3.4 each
    assert abs(episode_return + 30.3) < 3
    assert 0 < deaths < 8


@pytest.mark.parametrize("adapter", ADAPTERS)
def test_five_lines_are_enough_for_every_adapter(adapter: str, tmp_path, monkeypatch) -> None:
    code = block_on(adapter)
    assert len(re.findall(r"^(?!#|from |import |$)", code.rstrip(), re.MULTILINE)) <= 5, "besides imports"
    if importlib.util.find_spec(ADAPTERS[adapter]) is None:
        pytest.skip(f"{ADAPTERS[adapter]} is not installed here")
    monkeypatch.chdir(tmp_path)
    shown: dict[str, object] = {}
    exec(compile(code, README, "exec"), shown)
    if adapter == "PettingZoo":
        assert shown["env"].agents == []
    if adapter == "RLlib":
        train_once(shown["config"])


def train_once(config: Any) -> None:
    """One iteration of RLlib's, in this process and one small worker."""
    import ray

    ray.init("local", num_cpus=2, include_dashboard=False, log_to_driver=False)
    try:
        config.env_runners(num_env_runners=0).training(train_batch_size_per_learner=200, num_epochs=1)
        assert config.build_algo().train()["num_env_steps_sampled_lifetime"] >= 200
    finally:
        ray.shutdown()


def test_every_command_shown_exists() -> None:
    from typer.main import get_command

    from hipg_bench.cli import app

    shown = set(re.findall(r"hipg-bench ([a-z]+)", README.read_text(encoding="utf-8")))
    assert {"evaluate", "train", "video", "bench", "calibrate", "doctor"} <= shown
    assert shown <= set(get_command(app).commands)


def test_the_films_at_the_top_loop_and_are_small() -> None:
    names = re.findall(r'<img src="([^"]+\.webp)"', README.read_text(encoding="utf-8"))
    films = [README.parent / name for name in names]
    assert len(set(films)) == 6
    assert sum(film.stat().st_size for film in films) < 6_000_000
    for film in films:
        with Image.open(film) as image:
            assert image.n_frames > 50
            assert image.info["loop"] == 0, "0 means without end"
