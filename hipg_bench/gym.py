"""Importing this module registers every task with Gymnasium, as ``hipg/<task>-v<version>``.

>>> import gymnasium, hipg_bench.gym
>>> env = gymnasium.make("hipg/hazard_nav-4-v1")
>>> envs = gymnasium.make_vec("hipg/hazard_nav-4-v1", num_envs=64)

Gymnasium imports it itself where an id says so: ``gymnasium.make("hipg_bench.gym:hipg/hazard_nav-4-v1")``.
"""

from __future__ import annotations

import gymnasium

from hipg_bench.registry import tasks

for _name, _spec in tasks().items():
    gymnasium.register(
        f"hipg/{_name}-v{_spec.version}",
        entry_point="hipg_bench.adapters.gymnasium:HipgEnv",
        vector_entry_point="hipg_bench.adapters.gymnasium_vector:HipgVectorEnv",
        # the environment says itself what is wrong, naming the task
        order_enforce=False,
        kwargs={"task": _name},
    )
