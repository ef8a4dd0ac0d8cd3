"""Drives the PettingZoo adapter."""

import numpy as np
from drivers import Seen, keys_of, over_agents

from hipg_bench.adapters.pettingzoo import parallel_env


class Remove:
    dead = "remove"

    def __init__(self, task, seed, **overrides):
        self.env = parallel_env(task, dead=self.dead, seed=seed, **overrides)
        self.names = self.env.possible_agents

    def reset(self, seed=None):
        observations, infos = self.env.reset(seed=seed)
        return self.seen(observations, {}, {}, {}, infos)

    def step(self, action):
        return self.seen(*self.env.step(dict(zip(self.names, action, strict=True))))

    def close(self):
        self.env.close()

    def seen(self, observations, rewards, terminations, truncations, infos):
        count = len(self.names)
        return Seen(
            observation=over_agents(observations, count, self.env.observation_space("agent_0").shape),
            reward=over_agents(rewards, count),
            terminated=over_agents(terminations, count) == 1,
            truncated=over_agents(truncations, count) == 1,
            reported=np.isin(self.names, list(observations)),
            live=np.isin(self.names, self.env.agents),
            alive=over_agents({agent: info["alive"] for agent, info in infos.items()}, count) == 1,
            state=self.env.state(),
            over=not self.env.agents,
            info_keys=keys_of(infos.values()),
        )


class Ghost(Remove):
    dead = "ghost"
