"""hipg-bench: a MuJoCo benchmark suite for teams that lose members.

>>> import hipg_bench
>>> env = hipg_bench.make("hazard_nav-4", num_envs=64, seed=0)
>>> step = env.reset()
>>> step.observation.shape[:2]
(64, 4)
"""

from hipg_bench.env import BatchEnv, Step
from hipg_bench.layout import Block, Layout, TaskLayout
from hipg_bench.registry import make, tagged, task_spec, tasks
from hipg_bench.spec import TaskSpec

__version__ = "0.1.0"

__all__ = [
    "BatchEnv",
    "Block",
    "Layout",
    "Step",
    "TaskLayout",
    "TaskSpec",
    "make",
    "tagged",
    "task_spec",
    "tasks",
]
