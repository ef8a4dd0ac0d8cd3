"""Stable-Baselines3: B worlds of N agents as B * N slots of one ``VecEnv``, which share one policy.

>>> from stable_baselines3 import PPO
>>> from hipg_bench.adapters.sb3 import HipgVecEnv
>>> PPO("MlpPolicy", HipgVecEnv("hazard_nav-4", num_envs=64)).learn(1_000_000)

Slot ``b * N + i`` is agent i of world b. The dead stay in their slots to the end of the episode (see `death`)
and all N end together, for Stable-Baselines3 takes the end of a slot's episode for the start of its next.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium.spaces import Box
from jaxtyping import Float
from stable_baselines3.common.vec_env import VecEnv

from hipg_bench.adapters import death
from hipg_bench.arguments import MOST_SEED, numbers, whole
from hipg_bench.registry import make
from hipg_bench.spec import TaskSpec


class HipgVecEnv(VecEnv):
    """B worlds of a task; ``task_spec`` holds its numbers. Infos tell who is ``alive``."""

    def __init__(
        self,
        task: str | TaskSpec,
        num_envs: int = 1,
        seed: int | None = None,
        threads: int = 0,
        **overrides: Any,
    ) -> None:
        """Build B = ``num_envs`` worlds, as `hipg_bench.make`; without a seed they are others each time."""
        self._env = env = make(task, num_envs, seed, threads=threads, autoreset=False, **overrides)
        self.task_spec, self.render_mode = env.spec, None
        sees, does = Box(*env.layout.observation.limits), Box(-1.0, 1.0, (env.action_size,))
        super().__init__(num_envs * env.num_agents, sees, does)
        self._lived = np.ones((num_envs, env.num_agents), bool)
        self._action = np.empty(0)

    def reset(self) -> Float[np.ndarray, "slots O"]:
        """Start the next episodes; after ``seed(s)``, world b's is episode b of seed s."""
        step = self._env.reset(seed=self._seeds[0])
        self._reset_seeds()
        self._lived = step.info["alive"]
        return self._by_slot(step.observation)

    def seed(self, seed: int | None = None) -> list[int | None]:
        """From the next reset on, worlds are those of this seed.

        Raises:
            SpecError: not a whole number in 0..2^64 - 1.
        """
        if seed is not None:
            seed = whole(seed, f"{self.task_spec.task}: seed", 0, MOST_SEED)
        return list(super().seed(seed))

    def step_async(self, actions: Any) -> None:
        """Keep the actions (B * N, A) for `step_wait`."""
        self._action = actions

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """Advance by one control step; worlds whose episode ends start their next one.

        Raises:
            HipgError: no episode has begun.
            ActionError: not (B * N, A) numbers, or one for a live agent that is not finite.
        """
        env, shape = self._env, (self.num_envs, self._env.action_size)
        action = numbers(self._action, self.task_spec.task, shape, note=" (B * N, A)")
        step = env.step(action.reshape(env.num_envs, env.num_agents, env.action_size))
        terminated, truncated = death.ends(self.task_spec, step)
        done = terminated | truncated
        reward = death.pay(self.task_spec, step, self._lived).astype(np.float32)
        infos: list[dict[str, Any]] = [
            {"alive": alive, "TimeLimit.truncated": False} for alive in step.info["alive"].ravel().tolist()
        ]
        observation, self._lived = self._by_slot(step.observation), step.info["alive"]
        if done.any():
            for slot in np.flatnonzero(np.repeat(done, env.num_agents)).tolist():
                infos[slot]["terminal_observation"] = observation[slot]
                infos[slot]["TimeLimit.truncated"] = bool(truncated[slot // env.num_agents])
            begun = env.reset(worlds=np.flatnonzero(done))
            observation, self._lived = self._by_slot(begun.observation), begun.info["alive"]
        return observation, reward.ravel(), np.repeat(done, env.num_agents), infos

    def close(self) -> None:
        """Refuse further use."""
        self._env.close()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """One attribute of this object, as often as slots are asked for."""
        return [getattr(self, attr_name)] * len(list(self._get_indices(indices)))

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Set an attribute of this object: slots have none of their own."""
        setattr(self, attr_name, value)

    def env_method(
        self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any
    ) -> list[Any]:
        """Call a method of this object, once."""
        answer = getattr(self, method_name)(*method_args, **method_kwargs)
        return [answer] * len(list(self._get_indices(indices)))

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        """Nothing is."""
        return [False] * len(list(self._get_indices(indices)))

    def _by_slot(self, observation: Float[np.ndarray, "B N O"]) -> Float[np.ndarray, "slots O"]:
        return observation.reshape(self.num_envs, -1)
