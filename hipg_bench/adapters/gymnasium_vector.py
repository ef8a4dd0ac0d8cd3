"""Gymnasium's ``make_vec``: B worlds stepped together, each team as one agent (see `gymnasium`).

All three ways to go on after an episode are here, as ``autoreset_mode``: in the same step (the last
observations are in ``info["final_obs"]``), in the next, or by a reset with ``options={"reset_mask": ...}``.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium.envs.registration import EnvSpec
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from jaxtyping import Bool, Float

from hipg_bench.adapters.joint import check_drawing, joint_info, joint_spaces, split_action, told_horizon
from hipg_bench.arguments import MOST_SEED, whole
from hipg_bench.env import Step
from hipg_bench.errors import HipgError, RenderError, SpecError, hint
from hipg_bench.registry import make
from hipg_bench.spec import TaskSpec

Returned = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]
"""Observations (B, N * O), rewards, terminations, truncations (B,), infos."""


class HipgVectorEnv(VectorEnv[np.ndarray, np.ndarray, np.ndarray]):
    """B worlds of a task; ``task_spec`` holds the task's numbers."""

    # until it is built: Gymnasium before 1.4 closes also what could not be
    closed = True

    def __init__(
        self,
        task: str | TaskSpec,
        num_envs: int = 1,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        seed: int | None = None,
        threads: int = 0,
        render_mode: str | None = None,
        **overrides: Any,
    ) -> None:
        """Build the worlds.

        Args:
            task: a name, or a spec of your own.
            num_envs: B.
            autoreset_mode: when a world goes on with its next episode.
            seed: of the first episodes, by default another each time; a reset with a seed replaces it.
            threads: physics threads; 0 for all cores. Results do not depend on it.
            render_mode: None alone; many worlds are not drawn.
            **overrides: as for `hipg_bench.make`.

        Raises:
            UnknownNameError, SpecError, RenderError: an argument that is not allowed.
        """
        name = task if isinstance(task, str) else task.task
        if render_mode is not None:
            raise RenderError(
                f"{name}: many worlds are not drawn, got render_mode={render_mode!r}: one is, by "
                f"`gymnasium.make(..., render_mode='rgb_array')`, and so is each of several with "
                f"`gymnasium.make_vec(..., vectorization_mode='sync', render_mode='rgb_array')`"
            )
        check_drawing(name, overrides)
        self._mode = _checked(autoreset_mode)
        at_once = self._mode is AutoresetMode.SAME_STEP
        self._env = env = make(task, num_envs, seed, threads=threads, autoreset=at_once, **overrides)
        self.task_spec, self.num_envs = env.spec, env.num_envs
        self._spec: EnvSpec | None = None
        self.metadata = {"render_modes": [], "autoreset_mode": self._mode}
        self.single_observation_space, self.single_action_space = joint_spaces(env)
        self.observation_space = batch_space(self.single_observation_space, env.num_envs)
        self.action_space = batch_space(self.single_action_space, env.num_envs)
        self._ended = np.empty(0, np.int64)
        self.closed = False

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
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start the next episodes, with a seed world b's is episode b of that seed.

        Args:
            seed: one for all worlds.
            options: ``reset_mask`` (B,) bool, the worlds to start; all by default.

        Raises:
            HipgError: another mask.
        """
        if seed is not None:
            seed = whole(seed, f"{self.task_spec.task}: seed", 0, MOST_SEED)
        super().reset(seed=seed)
        mask = (options or {}).get("reset_mask", np.ones(self.num_envs, bool))
        if not isinstance(mask, np.ndarray) or mask.shape != (self.num_envs,) or mask.dtype != bool:
            raise HipgError(
                f"{self.task_spec.task}: a bool array of shape {(self.num_envs,)} is allowed as reset_mask, "
                f"got {mask!r}"
            )
        step = self._env.reset(worlds=np.flatnonzero(mask), seed=seed)
        self._ended = self._ended[~mask[self._ended]]
        return self._flat(step.observation), _masked(joint_info(step), np.ones(self.num_envs, bool))

    def step(self, actions: Any) -> Returned:
        """Advance every world by one control step; what worlds that begin in it are told is ignored.

        Args:
            actions: (B, N * A), in [-1, 1].

        Raises:
            HipgError: a world whose episode is over, without automatic reset, or has not begun.
            ActionError: not (B, N * A) numbers, or one for a live agent that is not finite.
        """
        action = split_action(self._env, actions, (self.num_envs,))
        step = self._begin(action) if len(self._ended) else self._env.step(action)
        done, info = step.terminated | step.truncated, joint_info(step)
        if self._mode is AutoresetMode.NEXT_STEP:
            self._ended = np.flatnonzero(done)
        told = _masked(info, np.ones(self.num_envs, bool))
        if self._mode is AutoresetMode.SAME_STEP and done.any():
            told |= self._last(step, info, done)
        return self._flat(step.observation), step.reward, step.terminated, step.truncated, told

    def close_extras(self, **_: Any) -> None:
        """Refuse further use."""
        self._env.close()

    def _begin(self, action: Float[np.ndarray, "B N A"]) -> Step:
        """Advance the worlds that are under way, start the others: they stand still in this step."""
        env, ids = self._env, self._ended
        env.reset(worlds=ids)
        rows = env.rows[ids]
        step = env.step(np.where(np.isin(np.arange(self.num_envs), ids)[:, None, None], 0.0, action))
        begun = env.load_rows(ids, rows)
        now, start = joint_info(step), joint_info(begun)
        for array, first in [(step.observation, begun.observation), *((now[k], start[k]) for k in now)]:
            array[ids] = first[ids]
        step.reward[ids], step.terminated[ids], step.truncated[ids] = 0.0, False, False
        return step

    def _last(self, step: Step, info: dict[str, Any], done: Bool[np.ndarray, "B"]) -> dict[str, Any]:
        """What Gymnasium's own vector environments tell when episodes end: their last, then their next."""
        final = self._flat(step.info["final_observation"])
        seen, state = np.full(self.num_envs, None, object), info["state"].copy()
        seen[done], state[done] = np.fromiter(final, object, len(final)), step.info["final_state"]
        last = {**info, "state": state, "alive": step.info["final_alive"]}
        begun = {name: np.where(done, 0.0, term) for name, term in info.items() if term.ndim == 1}
        return begun | _masked({"final_obs": seen, "final_info": _masked(last, done)}, done)

    def _flat(self, observation: Float[np.ndarray, "n N O"]) -> Float[np.ndarray, "n NO"]:
        return observation.reshape(len(observation), -1)


def _masked(info: dict[str, Any], has: Bool[np.ndarray, "B"]) -> dict[str, Any]:
    """Each entry with its mask, the worlds that have it, as Gymnasium wants it."""
    return {**info, **{f"_{name}": has for name in info}}


def _checked(mode: AutoresetMode | str) -> AutoresetMode:
    if mode not in [*AutoresetMode, *(each.value for each in AutoresetMode)]:
        names = [each.value for each in AutoresetMode]
        raise SpecError(f"autoreset_mode = {mode!r} is refused{hint(str(mode), names)}")
    return AutoresetMode(mode)
