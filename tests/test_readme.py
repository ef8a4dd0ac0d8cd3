"""What the README and the guide to adapters show works as shown."""

import importlib.util
import json
import re
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

README = Path(__file__).parent.parent / "README.md"
ADAPTERS_PAGE = README.parent / "docs" / "guides" / "adapters.md"
BLOCKS = re.findall(r"```python\n(.*?)```", ADAPTERS_PAGE.read_text(encoding="utf-8"), re.DOTALL)
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


def test_the_python_example_prints_what_the_readme_shows(capsys) -> None:
    text = README.read_text(encoding="utf-8")
    (code, shown), *others = re.findall(r"```python\n(.*?)```\n```\n(.*?)```", text, re.DOTALL)
    assert not others
    exec(compile(code, README, "exec"), {})
    assert capsys.readouterr().out == shown


def test_results_are_those_of_the_bundles() -> None:
    """The first three columns of the table of results, from the records beside the weights."""
    rows = re.findall(
        r"^\| `(\S+-\d+)` \|((?: [\d.]+ \[[^|]*\|){3})", README.read_text("utf-8"), re.MULTILINE
    )
    assert len(rows) == 7
    for task, cells in rows:
        agents = ("mappo_minhealth", "mappo_central", "mappo_local")
        for agent, cell in zip(agents, cells.strip(" |").split("|"), strict=True):
            records = list((README.parent / "agents" / agent / task).glob("seed?.json"))
            result = json.loads(min(records).read_text(encoding="utf-8"))["result"]
            low, high = result["score_ci95"]
            assert cell.strip() == f"{result['score']:.2f} [{low:.2f}, {high:.2f}]"


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

    text = re.sub(r"```bibtex\n.*?```", "", README.read_text(encoding="utf-8"), flags=re.DOTALL)
    shown = set(re.findall(r"hipg-bench ([a-z]+)", text))
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
