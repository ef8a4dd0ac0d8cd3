"""hipg-bench: a MuJoCo benchmark suite for teams that lose members.

>>> import hipg_bench
>>> env = hipg_bench.make("hazard_nav-4", num_envs=64, seed=0)
>>> step = env.reset()
>>> step.observation.shape[:2]
(64, 4)
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from hipg_bench.adapters.dm_env import load
    from hipg_bench.adapters.pettingzoo import parallel_env
    from hipg_bench.env import BatchEnv, Step
    from hipg_bench.layout import Block, Layout, TaskLayout
    from hipg_bench.registry import make, read_task, register_family, tagged, task_spec, tasks
    from hipg_bench.spec import TaskSpec

__version__ = "0.1.0"

__all__ = [
    "BatchEnv",
    "Block",
    "Layout",
    "Step",
    "TaskLayout",
    "TaskSpec",
    "load",
    "make",
    "parallel_env",
    "read_task",
    "register_family",
    "tagged",
    "task_spec",
    "tasks",
]

_HOMES = {
    "adapters.dm_env": ("load",),
    "adapters.pettingzoo": ("parallel_env",),
    "env": ("BatchEnv", "Step"),
    "layout": ("Block", "Layout", "TaskLayout"),
    "registry": ("make", "read_task", "register_family", "tagged", "task_spec", "tasks"),
    "spec": ("TaskSpec",),
}


def __getattr__(name: str) -> Any:
    """Import on first use: the command line answers before MuJoCo is loaded, and may choose its GL first."""
    for module, names in _HOMES.items():
        if name in names:
            from hipg_bench import processes

            with processes.children_leave_out_the_working_folder():  # MuJoCo's import starts one
                return getattr(importlib.import_module(f"hipg_bench.{module}"), name)
    raise AttributeError(f"module 'hipg_bench' has no attribute {name!r}")
