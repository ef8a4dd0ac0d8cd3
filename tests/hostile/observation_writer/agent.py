"""Writes a better world into what it is shown."""

from honest import Honest


class ObservationWriter(Honest):
    def act(self, observation, alive):
        action = super().act(observation, alive)
        observation.setflags(write=True)
        alive.setflags(write=True)
        observation[...] = 1.0
        alive[...] = True
        return action


def make_agent(task, train_seed):
    return ObservationWriter(task)
