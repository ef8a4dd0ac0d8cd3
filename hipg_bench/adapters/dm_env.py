"""dm_env and dm_control: ``hipg_bench.load("hazard_nav", "4")``, by the conventions of ``dm_control.suite``.

As in dm_control's soccer, specs, observations, actions and rewards are lists with one entry per agent; an
observation is a mapping of named arrays. The lists keep their length: a dead agent sees zeros with its own
health 0, is paid 0 from the step after its death, and what it is told is ignored. The rules end an episode
with discount 0, the time limit with discount 1.
"""

from __future__ import annotations

import secrets
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

import dm_env
import numpy as np
from dm_env import specs

from hipg_bench.adapters import death
from hipg_bench.adapters.agent_names import gather, numbered
from hipg_bench.adapters.joint import split_action
from hipg_bench.env import Step
from hipg_bench.errors import ActionError
from hipg_bench.registry import make, tasks
from hipg_bench.rendering import gl
from hipg_bench.spec import TaskSpec

if TYPE_CHECKING:
    from dm_control.mujoco import Physics

    from hipg_bench.rendering.mirror import Mirror

gl.choose_without_display()  # before dm_control is imported: it decides then

ALL_TASKS = tuple(name.rpartition("-")[::2] for name in tasks())
"""All (domain name, task name), as in the suite; the task ``hazard_nav-4`` is ``("hazard_nav", "4")``."""


def load(
    domain_name: str,
    task_name: str,
    task_kwargs: Mapping[str, Any] | None = None,
    environment_kwargs: Mapping[str, Any] | None = None,
    visualize_reward: bool = False,
) -> HipgEnvironment:
    """Return an environment, with the signature of ``dm_control.suite.load``.

    Args:
        domain_name: a task's name up to its last hyphen.
        task_name: the rest of it.
        task_kwargs: ``random``, a seed, a RandomState or Generator to draw it from, or None for another one
            each time; and overrides, as for `hipg_bench.make`.
        environment_kwargs: ``joint``, see `HipgEnvironment`.
        visualize_reward: without effect, as in the suite's tasks tagged ``no_reward_visualization``.

    Raises:
        UnknownNameError: no such task; the message holds the nearest name.
        SpecError: an override that is not allowed.
    """
    numbers = dict(task_kwargs or {})
    random = numbers.pop("random", None)
    if isinstance(random, np.random.RandomState):
        random = int(random.randint(2**31))
    elif isinstance(random, np.random.Generator):
        random = int(random.integers(2**63))
    return HipgEnvironment(f"{domain_name}-{task_name}", random, **(environment_kwargs or {}), **numbers)


class _Task(NamedTuple):
    """What wrappers of ``dm_control.suite`` ask of a task."""

    random: np.random.RandomState


class HipgEnvironment(dm_env.Environment):
    """One world of a task; ``spec`` holds its numbers, ``task.random`` is for wrappers that add noise.

    With ``joint`` the team is one agent, as single-agent learners and `suite.wrappers.pixels` expect: arrays
    of the observation have a leading axis N, an action is (N * A,), the reward is the team's.
    """

    def __init__(
        self, task: str | TaskSpec, seed: int | None = None, *, joint: bool = False, **overrides: Any
    ) -> None:
        self._env = make(task, 1, seed, threads=1, autoreset=False, **overrides)
        self.spec, self._joint = self._env.spec, joint
        self._alive, self._over = np.ones((1, self.spec.num_agents), bool), True
        self._number = numbered(self.spec)
        self._mirror: Mirror | None = None
        self.task = _Task(np.random.RandomState(secrets.randbits(32) if seed is None else seed % 2**32))

    def reset(self) -> dm_env.TimeStep:
        """Start the next episode."""
        step = self._env.reset()
        self._alive, self._over = step.info["alive"], False
        return dm_env.TimeStep(dm_env.StepType.FIRST, None, None, self._observation(step))

    def step(self, action: Any) -> dm_env.TimeStep:
        """Advance by one control step; at first, and after a LAST one, `reset` instead.

        Raises:
            ActionError: wrong shape, or a value for a live agent that is not finite.
            UnknownNameError: more actions than agents.
        """
        if self._over:
            return self.reset()
        if self._joint:
            step = self._env.step(split_action(self._env, action, ()))
            reward, (terminated,), (truncated,) = float(step.reward[0]), step.terminated, step.truncated
        else:
            told = {f"agent_{i}": part for i, part in enumerate(self._listed(action))}
            step = self._env.step(gather(self._env, self._number, told, self._alive[0].tolist()))
            reward = death.pay(self.spec, step, self._alive)[0].tolist()
            (terminated,), (truncated,) = death.ends(self.spec, step)
        self._alive, self._over = step.info["alive"], bool(terminated or truncated)
        kind = dm_env.StepType.LAST if self._over else dm_env.StepType.MID
        return dm_env.TimeStep(kind, reward, 0.0 if terminated else 1.0, self._observation(step))

    def observation_spec(self) -> Any:
        """Named arrays, as the task's layout has them."""
        lead = (self.spec.num_agents,) if self._joint else ()
        blocks = self._env.layout.observation.present
        return self._per_agent({b.name: specs.Array((*lead, *b.shape), np.float32, b.name) for b in blocks})

    def action_spec(self) -> Any:
        """Numbers in [-1, 1]."""
        size = self._env.action_size * (self.spec.num_agents if self._joint else 1)
        name = self._env.layout.action.blocks[0].name
        return self._per_agent(
            specs.BoundedArray((size,), np.float64, np.full(size, -1.0), np.ones(size), name)
        )

    def reward_spec(self) -> Any:
        """One number."""
        return self._per_agent(specs.Array((), np.float64, "reward"))

    def control_timestep(self) -> float:
        """Seconds per step."""
        return self.spec.control_step

    @property
    def physics(self) -> Physics:
        """The world as it is now, as a `dm_control.mujoco.Physics`; what is done to it moves nothing."""
        from hipg_bench.rendering.mirror import Mirror

        row = self._env.rows[0]
        self._mirror = self._mirror or Mirror(self.spec, row)
        return self._mirror.physics(row)

    def close(self) -> None:
        """Refuse further use."""
        self._env.close()

    def _listed(self, action: Any) -> Any:
        if not hasattr(action, "__len__") or isinstance(action, str | bytes | Mapping):
            raise ActionError(
                f"{self.spec.task}: a list with an action for each agent is allowed, got {action!r:.80}"
            )
        return action

    def _per_agent(self, part: Any) -> Any:
        return part if self._joint else [part] * self.spec.num_agents

    def _observation(self, step: Step) -> Any:
        layout, flat = self._env.layout.observation, step.observation[0]
        arrays = {block.name: layout.view(flat, block.name) for block in layout.present}
        agents = range(self.spec.num_agents)
        return arrays if self._joint else [{name: a[i] for name, a in arrays.items()} for i in agents]
