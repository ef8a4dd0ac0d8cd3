"""Gymnasium: the team as one agent. ``import hipg_bench.gym`` registers ``hipg/<task>-v<version>``.

The joint observation is the agents' observations one after another, the joint action likewise; the reward is
the team's, and an episode ends when the task says so, however many are dead. Infos hold the joint ``state``,
who is ``alive``, and the reward's terms, ``reward_<term>``.
"""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from gymnasium.envs.registration import EnvSpec
from jaxtyping import Float, UInt8

from hipg_bench.adapters.joint import check_drawing, joint_info, joint_spaces, split_action, told_horizon
from hipg_bench.arguments import MOST_SEED, whole
from hipg_bench.env import Step
from hipg_bench.errors import RenderError
from hipg_bench.registry import make
from hipg_bench.rendering.live import Live
from hipg_bench.spec import TaskSpec


class HipgEnv(gymnasium.Env[np.ndarray, np.ndarray]):
    """One world of a task; ``task_spec`` holds the task's numbers."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012 (as Gymnasium has it)

    def __init__(
        self, task: str | TaskSpec, render_mode: str | None = None, seed: int | None = None, **overrides: Any
    ) -> None:
        """Build the world.

        Args:
            task: a name, or a spec of your own.
            render_mode: ``rgb_array`` or nothing.
            seed: of the first episodes, by default another each time; a reset with a seed replaces it.
            **overrides: as for `hipg_bench.make`.

        Raises:
            UnknownNameError, SpecError, RenderError: an argument that is not allowed.
        """
        check_drawing(str(task) if isinstance(task, str) else task.task, overrides)
        self._env = env = make(task, 1, seed, threads=1, autoreset=False, **overrides)
        self.task_spec, self.render_mode = env.spec, render_mode
        self._spec: EnvSpec | None = None
        self.metadata = {**self.metadata, "render_fps": round(1 / env.spec.control_step)}
        if render_mode not in (None, "rgb_array"):
            raise RenderError(
                f"{env.spec.task}: the render mode 'rgb_array' is allowed, got {render_mode!r}; "
                f"`gymnasium.make(..., render_mode='human')` shows its pictures in a window, "
                f"with pip install 'hipg-bench[gymnasium]'"
            )
        self._live = Live(env.spec, render_mode) if render_mode else None
        self.observation_space, self.action_space = joint_spaces(env)

    # Gymnasium's own is an attribute, which it sets after it has built the environment
    @property
    def spec(self) -> EnvSpec | None:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Gymnasium's, with the horizon."""
        return self._spec

    @spec.setter
    def spec(self, registered: EnvSpec | None) -> None:  # pyright: ignore[reportIncompatibleVariableOverride]
        self._spec = told_horizon(registered, self.task_spec)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Float[np.ndarray, "NO"], dict[str, Any]]:
        """Start the next episode, with a seed episode 0 of that seed; ``options`` has no effect."""
        if seed is not None:
            seed = whole(seed, f"{self.task_spec.task}: seed", 0, MOST_SEED)
        super().reset(seed=seed)
        step = self._env.reset(seed=seed)
        if self._live:
            self._live.begin(self._env.rows[0])
        return self._look(step)

    def step(self, action: Any) -> tuple[Float[np.ndarray, "NO"], float, bool, bool, dict[str, Any]]:
        """Advance by one control step: a joint action (N * A,), in [-1, 1].

        Raises:
            HipgError: the episode is over or has not begun.
            ActionError: not N * A numbers, or one for a live agent that is not finite.
        """
        step = self._env.step(split_action(self._env, action, ()))
        if self._live:
            self._live.see(self._env.rows[0])
        observation, info = self._look(step)
        return observation, float(step.reward[0]), bool(step.terminated[0]), bool(step.truncated[0]), info

    def render(self) -> UInt8[np.ndarray, "height width 3"] | None:
        """The world as it is.

        Raises:
            RenderError: no episode has begun, or no OpenGL works here.
        """
        return self._live.picture() if self._live else None

    def close(self) -> None:
        """Refuse further use."""
        self._env.close()
        if self._live:
            self._live.close()

    def _look(self, step: Step) -> tuple[Float[np.ndarray, "NO"], dict[str, Any]]:
        """Observation and info of the only world."""
        info = {name: value[0] for name, value in joint_info(step).items()}
        return step.observation.reshape(-1), info
