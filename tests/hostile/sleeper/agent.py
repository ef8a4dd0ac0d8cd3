"""Takes more than its time at every step, each a little."""

import time

from honest import Honest


class Sleeper(Honest):
    def act(self, observation, alive):
        time.sleep(0.8)
        return super().act(observation, alive)


def make_agent(task, train_seed):
    return Sleeper(task)
