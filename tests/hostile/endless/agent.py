"""Never answers."""

from honest import Honest


class Endless(Honest):
    def act(self, observation, alive):
        while True:
            pass


def make_agent(task, train_seed):
    return Endless(task)
