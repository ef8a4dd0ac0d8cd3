"""Takes memory until there is no more."""

import numpy as np
from honest import Honest


class MemoryHog(Honest):
    def act(self, observation, alive):
        taken = []
        while True:
            taken.append(np.ones(16 << 20, np.uint8))


def make_agent(task, train_seed):
    return MemoryHog(task)
