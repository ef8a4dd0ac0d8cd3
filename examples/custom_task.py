"""A task of your own: its numbers in careful_nav-5.toml, and a family with one more term of reward.

It then goes wherever a task's name goes: `hipg_bench.make`, `HipgEnv`, `HipgEnvironment`, `parallel_env`, ...
"""

from pathlib import Path

import numpy as np

import hipg_bench
from hipg_bench import registry, spec
from hipg_bench.families.hazard_nav import HazardNav, Snapshot


class CarefulNav(HazardNav):
    """Hazard navigation in which the team is charged for every drone that it loses."""

    def reward(self, was: Snapshot, now: Snapshot) -> dict[str, np.ndarray]:
        """Terms (B,), from the worlds before and after a step; the file has their weights."""
        lost = (was.health > 0) & (now.health == 0)
        return {**super().reward(was, now), "lost": lost.sum(axis=1).astype(float)}


registry.FAMILIES["careful_nav"] = CarefulNav
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
