"""Prints without end, in words and in raw bytes, and writes what looks like answers."""

import contextlib
import os
import sys

from honest import Honest


class Flooder(Honest):
    def act(self, observation, alive):
        sys.stdout.write("word " * 50_000)
        sys.stderr.write("word " * 50_000)
        for pipe in (1, 2):
            with contextlib.suppress(OSError):
                os.write(pipe, bytes(range(256)) * 1000)
        return super().act(observation, alive)


def make_agent(task, train_seed):
    return Flooder(task)
