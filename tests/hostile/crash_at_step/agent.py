"""Plays well for ten steps and ends its process while the going is good."""

import os

from honest import Honest


class CrashAtStep(Honest):
    steps = 0

    def act(self, observation, alive):
        self.steps += 1
        if self.steps > 10:
            os._exit(1)
        return super().act(observation, alive)


def make_agent(task, train_seed):
    return CrashAtStep(task)
