"""What the README shows works as shown."""

import re
from pathlib import Path

README = Path(__file__).parent.parent / "README.md"


def test_the_python_example_runs_and_prints_a_return_and_deaths(capsys) -> None:
    (code,) = re.findall(r"```python\n(.*?)```", README.read_text(encoding="utf-8"), re.DOTALL)
    exec(compile(code, README, "exec"), {})
    episode_return, deaths = map(float, capsys.readouterr().out.split())
    # anchor of random play in the task file: -30.3; 64 episodes with a deviation of about 3.4 each
    assert abs(episode_return + 30.3) < 3
    assert 0 < deaths < 8


def test_every_command_shown_exists() -> None:
    from typer.main import get_command

    from hipg_bench.cli import app

    shown = set(re.findall(r"hipg-bench ([a-z]+)", README.read_text(encoding="utf-8")))
    assert {"evaluate", "train", "video", "bench", "calibrate", "doctor"} <= shown
    assert shown <= set(get_command(app).commands)
