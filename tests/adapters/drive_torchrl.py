"""Drives the TorchRL adapter."""

import numpy as np
import torch
from drivers import Seen

from hipg_bench.adapters.torchrl import HipgEnv


class Group:
    dead = "ghost"

    def __init__(self, task, seed, **overrides):
        self.env = HipgEnv(task, 1, seed, **overrides)

    def reset(self, seed=None):
        if seed is not None:
            self.env.set_seed(seed)
        self.now = self.env.reset()
        return self.seen(self.now)

    def step(self, action):
        asked = self.now.set(("agents", "action"), torch.from_numpy(action)[None])
        self.now = self.env.step(asked)["next"].exclude(("agents", "reward"))
        return self.seen(asked["next"])

    def close(self):
        self.env.close()

    def seen(self, shown):
        agents = {name: array[0].numpy() for name, array in shown["agents"].items()}
        count = len(agents["alive"])
        done, terminated, truncated = (
            np.repeat(shown[name][0].numpy(), count) for name in ("done", "terminated", "truncated")
        )
        return Seen(
            observation=agents["observation"],
            reward=agents.get("reward", np.zeros((count, 1)))[:, 0],
            terminated=terminated,
            truncated=truncated,
            reported=np.ones(count, bool),
            live=~done,
            alive=agents["alive"][:, 0],
            state=shown["state"][0].numpy(),
            over=bool(done.all()),
            info_keys=frozenset({()}),
        )
