"""Drives the dm_env adapter: a list entry per agent, and the team as one agent."""

import numpy as np
from drivers import Seen

from hipg_bench.adapters.dm_env import load
from hipg_bench.registry import definition_of


class Lists:
    dead = "ghost"
    joint = False

    def __init__(self, task, seed, **overrides):
        self.names, self.numbers = task.rsplit("-", 1), overrides
        self.env = self.load(seed)
        layout = definition_of(self.env.spec).layout
        self.health, self.dead_value = layout.health_block, layout.dead_value

    def load(self, seed):
        return load(*self.names, {"random": seed, **self.numbers}, {"joint": self.joint})

    def reset(self, seed=None):
        if seed is not None:
            # dm_env seeds an environment when it is built
            self.env = self.load(seed)
        return self.seen(self.env.reset())

    def step(self, action):
        return self.seen(self.env.step(list(action)))

    def close(self):
        self.env.close()

    def agents(self, observation):
        return observation

    def seen(self, shown):
        agents = self.agents(shown.observation)
        everyone = np.ones(len(agents), bool)
        return Seen(
            observation=np.stack([np.concatenate([a.ravel() for a in agent.values()]) for agent in agents]),
            reward=np.zeros(len(agents)) if shown.first() else everyone * np.asarray(shown.reward),
            terminated=everyone & (shown.last() and shown.discount == 0),
            truncated=everyone & (shown.last() and shown.discount == 1),
            reported=everyone,
            live=everyone & (not shown.last()),
            alive=np.array([agent[self.health].item() != self.dead_value for agent in agents]),
            state=None,
            over=shown.last(),
            info_keys=frozenset({()}),
        )


class Joint(Lists):
    dead = "joint"
    joint = True

    def step(self, action):
        return self.seen(self.env.step(action.ravel()))

    def agents(self, observation):
        count = self.env.spec.num_agents
        return [{name: array[i] for name, array in observation.items()} for i in range(count)]
