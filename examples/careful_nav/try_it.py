"""A task of your own: its numbers in careful_nav-5.toml, its family with one more reward term beside it.

It then goes wherever a task's name goes: `hipg_bench.make`, `HipgEnv`, `HipgEnvironment`, `parallel_env`, ...
"""

from pathlib import Path

import careful_nav  # beside this file
import numpy as np

import hipg_bench
from hipg_bench import spec

hipg_bench.register_family("careful_nav", careful_nav)
task = spec.load(Path(__file__).with_name("careful_nav-5.toml"))

# every number of the file can be changed in passing
for peak in (0.0, 0.25, 0.5):
    env = hipg_bench.make(task, num_envs=64, seed=0, autoreset=False, hazard_peak=peak)
    chance, total = np.random.default_rng(0), dict.fromkeys(task.weights, 0.0)
    step = env.reset()
    while not step.truncated.any():
        step = env.step(chance.uniform(-1, 1, (64, env.num_agents, env.action_size)))
        for name in total:
            total[name] += step.info["terms"][name].mean()
    terms = ", ".join(f"{name} {value:.2f}" for name, value in total.items())
    metrics = step.info["metrics"]
    print(
        f"peak {peak}: return {metrics['return'].mean():.2f} = {terms}; {metrics['deaths'].mean():.2f} dead"
    )
