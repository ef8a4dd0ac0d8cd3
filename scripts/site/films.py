"""Record the films of the README and of the site's task pages: python scripts/site/films.py [TASK...].

The agent is mappo_minhealth where it plays the task, else its policy of a smaller team.
"""

import subprocess
import sys
import tempfile
from pathlib import Path

import imageio.v3 as iio
from PIL import Image

from hipg_bench.policies.bundle import load_agent
from hipg_bench.registry import tasks

OUT = Path(__file__).parents[2] / "docs" / "films"
SMALLER_TEAM = {"multiwalker_planar-5": "agents/mappo_minhealth/multiwalker_planar-3/seed0.safetensors"}
SIZE, FPS = (400, 224), 12


def record(task: str) -> Path:
    """Play public world 2 of a task and write its film, like the leaderboard's."""
    agent = "mappo_minhealth" if task in load_agent("mappo_minhealth").tasks else SMALLER_TEAM[task]
    with tempfile.TemporaryDirectory() as folder:
        video = Path(folder) / "film.mp4"
        command = ["hipg-bench", "video", "--task", task, "--agent", agent, "--episode", "2"]
        size = ["--width", str(2 * SIZE[0]), "--height", str(2 * SIZE[1]), "--fps", str(FPS)]
        program = Path(sys.executable).parent / command[0]
        subprocess.run([program, *command[1:], *size, "--out", video], check=True)
        frames = [
            Image.fromarray(frame).resize(SIZE, Image.Resampling.LANCZOS) for frame in iio.imiter(video)
        ]
    path = OUT / f"{task}.webp"
    frames[0].save(
        path,
        save_all=True,
        append_images=frames[1:],
        duration=round(1000 / FPS),
        loop=0,
        quality=55,
        method=6,
    )
    return path


if __name__ == "__main__":
    for name in sys.argv[1:] or tasks():
        film = record(name)
        print(f"{film}: {film.stat().st_size:,} bytes")
