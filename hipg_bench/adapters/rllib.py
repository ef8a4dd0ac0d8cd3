"""RLlib's new API stack: a task as a ``MultiAgentEnv`` whose dead leave the episode.

>>> from ray.rllib.algorithms.ppo import PPOConfig
>>> from hipg_bench.adapters.rllib import HipgMultiAgentEnv
>>> config = PPOConfig().environment(HipgMultiAgentEnv, env_config={"task": "hazard_nav-4"})
>>> config = config.multi_agent(policies={"team"}, policy_mapping_fn=lambda agent, *_, **__: "team")
>>> config = config.debugging(seed=0)

Do give RLlib a seed: its check of an environment resets every copy with the same one, and where no other
follows, all copies go on in the same worlds.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium.spaces import Box
from jaxtyping import UInt8
from ray.rllib.env.multi_agent_env import MultiAgentEnv

from hipg_bench.adapters.agent_names import gather, numbered
from hipg_bench.env import Step
from hipg_bench.errors import HipgError, SpecError
from hipg_bench.registry import make, tasks
from hipg_bench.rendering.live import Live

Told = dict[str, Any]
"""By agent; flags also hold RLlib's ``"__all__"``, the episode as a whole."""


class HipgMultiAgentEnv(MultiAgentEnv):
    """One world of a task.

    The step of an agent's death is the last that names it, ``terminated``. ``"__all__"`` says what became of
    the episode: terminated by the rules or with the last death, truncated at the horizon. The horizon is told
    by ``"__all__"`` alone: RLlib takes an episode in which every agent has a flag of its own for a
    *terminated* one, and would cut off the values of those who live on instead of bootstrapping them.

    Attributes:
        task: the task's numbers.
        agents: whom the latest dicts name, the newly dead among them.
        possible_agents: the team.
    """

    def __init__(self, config: Mapping[str, Any]) -> None:
        """Read RLlib's ``env_config``.

        Args:
            config: ``task``, a name or a spec; ``render_mode``, ``human``, ``rgb_array`` or None; and
                overrides, as for `hipg_bench.make`.

        Raises:
            UnknownNameError: no such task.
            SpecError: no task at all, or an override that is not allowed.
        """
        super().__init__()
        numbers = dict(config)
        if "task" not in numbers:
            raise SpecError(f"env_config needs a 'task'; there are: {', '.join(tasks())}")
        task, self.render_mode = numbers.pop("task"), numbers.pop("render_mode", None)
        # RLlib seeds by reset(seed=...); without that, copies differ
        seed = int(self.np_random.integers(2**31))
        self._env = env = make(task, 1, seed, threads=1, autoreset=False, **numbers)
        self.task = env.spec
        self.metadata = {
            "render_modes": ["human", "rgb_array"], "render_fps": round(1 / env.spec.control_step),
        }  # fmt: skip
        self._live = Live(env.spec, self.render_mode) if self.render_mode else None
        self._number = numbered(env.spec)
        self.possible_agents, self.agents = list(self._number), []
        self.observation_spaces = {a: Box(*env.layout.observation.limits) for a in self._number}
        self.action_spaces = {a: Box(-1.0, 1.0, (env.action_size,)) for a in self._number}
        self._acts = np.zeros(env.num_agents, bool)

    def reset(
        self, *, seed: int | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[Told, Told]:
        """Start the next episode, with a seed episode 0 of that seed; ``options`` has no effect."""
        step = self._env.reset(seed=seed)
        self._acts, self.agents = step.info["alive"][0], list(self.possible_agents)
        if self._live:
            self._live.begin(self._env.rows[0])
        return self._look(step)

    def step(self, action_dict: Mapping[str, Any]) -> tuple[Told, Told, Told, Told, Told]:
        """Advance by one control step: observations, rewards, terminations, truncations, infos.

        Args:
            action_dict: (A,) for each live agent, in [-1, 1]; what the dead are told is ignored.

        Raises:
            HipgError: the episode is over or has not begun.
            UnknownNameError, ActionError: a stranger's action; one that is missing, malformed, not finite.
        """
        if not self._acts.any():
            raise HipgError(f"{self.task.task}: reset() comes first: no episode has begun, or it is over")
        step = self._env.step(gather(self._env, self._number, action_dict, self._acts.tolist()))
        self.agents = [a for a in self.possible_agents if self._acts[self._number[a]]]
        alive = step.info["alive"][0]
        terminated = bool(step.terminated[0]) or not alive.any()
        truncated = not terminated and bool(step.truncated[0])
        gone = {a: terminated or not alive[self._number[a]] for a in self.agents}
        self._acts = alive & (not (terminated or truncated))
        if self._live:
            self._live.see(self._env.rows[0])
        observations, infos = self._look(step)
        rewards = dict.fromkeys(self.agents, float(step.reward[0]))
        return observations, rewards, gone | {"__all__": terminated}, {"__all__": truncated}, infos

    def render(self) -> UInt8[np.ndarray, "height width 3"] | None:
        """The world as it is, with ``rgb_array``; a window shows it by itself.

        Raises:
            HipgError: no episode has begun.
            RenderError: no OpenGL works here.
        """
        if not self.agents:
            raise HipgError(f"{self.task.task}: reset() comes before render()")
        return self._live.picture() if self._live and self.render_mode == "rgb_array" else None

    def close(self) -> None:
        """Refuse further use."""
        self._env.close()
        self._acts, self.agents = np.zeros_like(self._acts), []
        if self._live:
            self._live.close()

    def _look(self, step: Step) -> tuple[Told, Told]:
        """Observations and infos of `agents`."""
        alive, health, number = step.info["alive"][0].tolist(), step.info["health"][0].tolist(), self._number
        infos = {a: {"alive": alive[number[a]], "health": health[number[a]]} for a in self.agents}
        return {a: step.observation[0, number[a]] for a in self.agents}, infos
