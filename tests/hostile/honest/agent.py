"""An honest agent: each drone flies to the nearest safe point that it is nearest to."""

import numpy as np


class Honest:
    """For hazard_nav-4, where an agent sees points nearest first."""

    def __init__(self, task):
        ends = np.cumsum([np.prod(block["shape"]) for block in task["observation"]]).tolist()
        starts = [0, *ends[:-1]]
        names = [block["name"] for block in task["observation"]]
        self.columns = {name: slice(a, b) for name, a, b in zip(names, starts, ends, strict=True)}
        self.task = task

    def reset(self, seeds):
        """Nothing to remember."""

    def act(self, observation, alive):
        see = {name: observation[..., columns] for name, columns in self.columns.items()}
        points = see["point_position"].reshape(*alive.shape, -1, 3)
        distance = np.linalg.norm(points, axis=-1)
        gap = np.where(see["point_gap"] > 0, see["point_gap"], np.inf)
        cost = distance + 10.0 * (gap < distance) + 100.0 * (see["point_hazardous"] > 0)
        nearest = cost.argmin(-1)
        target = np.take_along_axis(points, nearest[..., None, None], -2)[..., 0, :]
        return np.clip(3.0 * target - 2.0 * see["velocity"], -1.0, 1.0)


def make_agent(task, train_seed):
    return Honest(task)
