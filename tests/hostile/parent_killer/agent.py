"""Signals everybody it can name; it fails if it succeeds."""

import contextlib
import json
import os
import pathlib
import signal

from honest import Honest


class ParentKiller(Honest):
    def act(self, observation, alive):
        targets = json.loads((pathlib.Path(__file__).parent / "targets.json").read_text())
        for process in (targets["victim"], targets["parent"], os.getppid(), -1, 0):
            with contextlib.suppress(OSError):
                os.kill(process, signal.SIGKILL)
                raise SystemExit(f"killed {process}")
        return super().act(observation, alive)


def make_agent(task, train_seed):
    return ParentKiller(task)
