"""Periodic evaluation: a policy plays without exploration in worlds used for neither training nor scores."""

from __future__ import annotations

import math

import numpy as np
from scipy import stats

from hipg_bench.env import BatchEnv
from hipg_bench.policies.policy import Policy
from hipg_bench.registry import make, task_spec

SEED = 30_000
"""The worlds' seed. Training has the seeds 0..999, scores those from 1000 on, calibration 10,000 and 20,000.

It is one for all runs, so that the points of all curves of a task are of the same worlds and the same random
numbers.
"""


def num_episodes(task: str) -> int:
    """Worlds of a periodic evaluation, of which the first episode counts: 128 of the paper's, else 32."""
    return 128 if "paper" in task_spec(task).tags else 32


class PeriodicEvaluation:
    """The worlds of a task in which learners are evaluated periodically.

    Attributes:
        env: the worlds, paid as the task pays, without the weights of training.
    """

    def __init__(self, task: str, *, threads: int = 1) -> None:
        self.env: BatchEnv = make(task, num_episodes(task), SEED, threads=threads)

    def play(self, policy: Policy) -> dict[str, float]:
        """Play every world's first episode.

        Draws nothing from torch's or NumPy's global random state: a run is the same with and without it.

        Returns:
            ``eval_return``, the mean return; and where the task has anchors ``score``, the same on their
            scale, with ``score_low`` and ``score_high``, the ends of Student's 95 % interval of the mean
            over the episodes.
        """
        env = self.env
        episodes = np.arange(env.num_envs)
        step = env.reset(episodes)
        memory = policy.initial_state(SEED, episodes, env.num_agents)
        returns = np.full(env.num_envs, np.nan)
        while np.isnan(returns).any():
            action, memory = policy.act(step.observation, memory, step.info["alive"])
            step = env.step(action)
            np.copyto(returns, step.info["metrics"]["return"], where=np.isnan(returns))
        mean = float(returns.mean())
        if env.spec.anchors is None:
            return {"eval_return": mean}
        half = float(stats.t.ppf(0.975, len(returns) - 1) * returns.std(ddof=1) / math.sqrt(len(returns)))
        low, high = env.spec.score(mean - half), env.spec.score(mean + half)
        return {"eval_return": mean, "score": env.spec.score(mean), "score_low": low, "score_high": high}
