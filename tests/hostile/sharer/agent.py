"""Claims to be decentralised, and tells every agent what any of them knows of hazards."""

import numpy as np
from honest import Honest


class Sharer(Honest):
    def act(self, observation, alive):
        action = super().act(observation, alive)
        told = action.copy()
        told[:, 1:] = 0.9 * action[:, 1:] + 0.1 * action[:, :1]  # a little of what the first one does
        return np.clip(told, -1, 1)


def make_agent(task, train_seed):
    return Sharer(task)
