"""Drives the RLlib adapter."""

import numpy as np
from drivers import Seen, keys_of, over_agents

from hipg_bench.adapters.rllib import HipgMultiAgentEnv


class Leaving:
    dead = "remove"

    def __init__(self, task, seed, **overrides):
        self.env = HipgMultiAgentEnv({"task": task, **overrides})
        self.names = self.env.possible_agents
        self.seed = seed

    def reset(self, seed=None):
        # RLlib's way to seed is the first reset
        seed, self.seed = self.seed if seed is None else seed, None
        observations, infos = self.env.reset(seed=seed)
        return self.seen(observations, {}, {"__all__": False}, {"__all__": False}, infos)

    def step(self, action):
        return self.seen(*self.env.step(dict(zip(self.names, action, strict=True))))

    def close(self):
        self.env.close()

    def seen(self, observations, rewards, terminateds, truncateds, infos):
        count, ended, timeout = len(self.names), terminateds.pop("__all__"), truncateds.pop("__all__")
        reported = np.isin(self.names, list(observations))
        terminated = (over_agents(terminateds, count) == 1) | (reported & ended)
        return Seen(
            observation=over_agents(observations, count, self.env.observation_spaces["agent_0"].shape),
            reward=over_agents(rewards, count),
            terminated=terminated,
            # RLlib tells the horizon by __all__ alone
            truncated=reported & ~terminated & timeout,
            reported=reported,
            live=reported & ~terminated & (not timeout),
            alive=over_agents({agent: info["alive"] for agent, info in infos.items()}, count) == 1,
            state=None,
            over=ended or timeout,
            info_keys=keys_of(infos.values()),
        )
