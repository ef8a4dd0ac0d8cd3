"""Drives the Gymnasium adapters: one environment, and vectors of one world with each way to go on."""

import gymnasium
import numpy as np
from drivers import Seen, keys_of
from gymnasium.vector import AutoresetMode

import hipg_bench.gym  # noqa: F401 (registers)
from hipg_bench import task_spec


def named(task):
    return f"hipg/{task}-v{task_spec(task).version}"


def joint(env_spec, observation, reward, terminated, truncated, info):
    """What the team was told, as if each agent had been told it."""
    count = env_spec.num_agents
    every = np.ones(count, bool)
    return Seen(
        observation=observation.reshape(count, -1),
        reward=np.full(count, reward, np.float64),
        terminated=every & terminated,
        truncated=every & truncated,
        reported=every,
        live=every & (not (terminated or truncated)),
        alive=info["alive"],
        state=info["state"],
        over=bool(terminated or truncated),
        info_keys=keys_of([info]),
    )


class Joint:
    dead = "joint"

    def __init__(self, task, seed, **overrides):
        self.env = gymnasium.make(named(task), seed=seed, **overrides)
        self.spec = self.env.unwrapped.task_spec

    def reset(self, seed=None):
        observation, info = self.env.reset(seed=seed)
        return joint(self.spec, observation, 0.0, False, False, info)

    def step(self, action):
        return joint(self.spec, *self.env.step(action.reshape(-1)))

    def close(self):
        self.env.close()


class Vector:
    dead = "joint"
    mode: AutoresetMode

    def __init__(self, task, seed, **overrides):
        self.envs = gymnasium.make_vec(named(task), 1, seed=seed, autoreset_mode=self.mode, **overrides)
        self.spec = self.envs.unwrapped.task_spec
        self.over = None

    def reset(self, seed=None):
        if self.over and seed is None:
            observation, info = self.begin()
        else:
            observation, info = self.envs.reset(seed=seed)
        self.over = None
        return self.seen(observation, np.zeros(1), *np.zeros((2, 1), bool), info)

    def step(self, action):
        returned = self.envs.step(action.reshape(1, -1))
        if returned[2][0] or returned[3][0]:
            self.over = returned
        return self.seen(*returned)

    def close(self):
        self.envs.close()

    def seen(self, observation, reward, terminated, truncated, info):
        first = {name: value[0] for name, value in info.items() if not name.startswith("_")}
        return joint(self.spec, observation[0], reward[0], terminated[0], truncated[0], first)


class SameStep(Vector):
    mode = AutoresetMode.SAME_STEP

    def begin(self):
        observation, *_, info = self.over
        return observation, {name: value for name, value in info.items() if "final" not in name}

    def seen(self, observation, reward, terminated, truncated, info):
        if "final_obs" in info and self.over:
            assert info["_final_obs"][0]
            assert info["_final_info"][0]
            observation, info = info["final_obs"], info["final_info"]
        return super().seen(observation, reward, terminated, truncated, info)


class NextStep(Vector):
    mode = AutoresetMode.NEXT_STEP

    def begin(self):
        anything = np.full(self.envs.action_space.shape, np.nan, np.float32)
        observation, reward, terminated, truncated, info = self.envs.step(anything)
        assert [reward[0], terminated[0], truncated[0]] == [0, False, False]
        return observation, info


class Disabled(Vector):
    mode = AutoresetMode.DISABLED

    def begin(self):
        return self.envs.reset(options={"reset_mask": np.ones(1, bool)})
