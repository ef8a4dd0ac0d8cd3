"""Drives the Stable-Baselines3 adapter."""

import numpy as np
from drivers import Seen, keys_of

from hipg_bench.adapters.sb3 import HipgVecEnv


class Slots:
    dead = "ghost"

    def __init__(self, task, seed, **overrides):
        self.env = HipgVecEnv(task, num_envs=1, seed=seed, **overrides)
        self.begun = None

    def reset(self, seed=None):
        count = self.env.num_envs
        if seed is not None:
            self.env.seed(seed)
            self.begun = None
        observation = self.env.reset() if self.begun is None else self.begun
        self.begun = None
        infos = [{"alive": True, "TimeLimit.truncated": False}] * count
        return self.seen(observation, np.zeros(count), np.zeros(count, bool), infos)

    def step(self, action):
        observation, reward, done, infos = self.env.step(action)
        if done.all():
            self.begun = observation
            observation = np.stack([info.pop("terminal_observation") for info in infos])
        return self.seen(observation, reward, done, infos)

    def close(self):
        self.env.close()

    def seen(self, observation, reward, done, infos):
        late = np.array([info["TimeLimit.truncated"] for info in infos])
        every = np.ones(len(done), bool)
        return Seen(
            observation=observation,
            reward=reward,
            terminated=done & ~late,
            truncated=late,
            reported=every,
            live=every & ~done,
            alive=np.array([info["alive"] for info in infos]),
            state=None,
            over=bool(done.all()),
            info_keys=keys_of(infos),
        )
