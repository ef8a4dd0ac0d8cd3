"""Makes the dead fly, and poisons what they answer."""

import numpy as np
from honest import Honest


class AnswersForTheDead(Honest):
    def act(self, observation, alive):
        action = super().act(observation, alive)
        return np.where(alive[..., None], action, [np.nan, np.inf, 1e300])


def make_agent(task, train_seed):
    return AnswersForTheDead(task)
