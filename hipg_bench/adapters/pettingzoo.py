"""PettingZoo: ``hipg_bench.parallel_env("hazard_nav-4")``, or ``pettingzoo.make("parallel", "hipg/...")``.

The dead leave (``dead="remove"``: the step of its death is the last that names an agent), or stay in the team
(``dead="ghost"``: N is fixed, see `death`). PettingZoo's own ``parallel_to_aec`` makes an AEC environment.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pettingzoo
from gymnasium.spaces import Box
from jaxtyping import Float, UInt8

from hipg_bench.adapters import death
from hipg_bench.adapters.agent_names import checked_name, gather, numbered
from hipg_bench.env import Step
from hipg_bench.errors import HipgError, SpecError, hint
from hipg_bench.registry import make, tasks
from hipg_bench.rendering.live import Live
from hipg_bench.spec import TaskSpec

Told = dict[str, Any]
"""By agent."""


class HipgParallelEnv(pettingzoo.ParallelEnv[str, np.ndarray, np.ndarray]):
    """One world of a task; what pickle and deepcopy make of it goes on where it was.

    Infos hold ``alive`` and ``health``.

    Attributes:
        task_spec: the task's numbers.
        agents: who acts next; empty when the episode is over.
        state_space: of `state`.
    """

    def __init__(
        self,
        task: str | TaskSpec,
        dead: str = "remove",
        render_mode: str | None = None,
        seed: int | None = None,
        **overrides: Any,
    ) -> None:
        """Build the world.

        Args:
            task: a name, or a spec of your own.
            dead: ``remove`` or ``ghost``, what becomes of the dead.
            render_mode: ``human`` for a window, ``rgb_array`` for pictures.
            seed: of the first episodes, by default another each time; a reset with a seed replaces it.
            **overrides: as for `hipg_bench.make`.

        Raises:
            UnknownNameError, SpecError, RenderError: an argument that is not allowed.
        """
        self._env = env = make(task, 1, seed, threads=1, autoreset=False, **overrides)
        self.task_spec = spec = env.spec
        if dead not in ("remove", "ghost"):
            raise SpecError(f"{spec.task}: dead = {dead!r} is refused{hint(dead, ('remove', 'ghost'))}")
        self._remove, self.render_mode = dead == "remove", render_mode
        self._live = Live(spec, render_mode) if render_mode else None
        self.metadata = {
            "name": f"{spec.task}_v{spec.version}", "is_parallelizable": True,
            "render_modes": ["human", "rgb_array"], "render_fps": round(1 / spec.control_step),
        }  # fmt: skip
        self._number = numbered(spec)
        self.possible_agents, self.agents = list(self._number), []
        self._sees = {agent: Box(*env.layout.observation.limits) for agent in self._number}
        self._does = {agent: Box(-1.0, 1.0, (env.action_size,)) for agent in self._number}
        self.state_space = Box(*env.layout.state.limits)
        self._now: Step | None = None

    def observation_space(self, agent: str) -> Box:
        """An agent's own, the same object each time."""
        return self._sees[checked_name(self.task_spec, agent, self._number)]

    def action_space(self, agent: str) -> Box:
        """An agent's own, the same object each time."""
        return self._does[checked_name(self.task_spec, agent, self._number)]

    def reset(self, seed: int | None = None, options: Mapping[str, Any] | None = None) -> tuple[Told, Told]:
        """Start the next episode, with a seed episode 0 of that seed; ``options`` has no effect."""
        step = self._now = self._env.reset(seed=seed)
        self.agents = list(self.possible_agents)
        if self._live:
            self._live.begin(self._env.rows[0])
        return self._look(step, self.agents)

    def step(self, actions: Mapping[str, Any]) -> tuple[Told, Told, Told, Told, Told]:
        """Advance by one control step: observations, rewards, terminations, truncations, infos.

        Args:
            actions: (A,) for each live agent, in [-1, 1]; what the dead are told is ignored.

        Raises:
            HipgError: the episode is over or has not begun.
            UnknownNameError, ActionError: a stranger's action; one that is missing, malformed, not finite.
        """
        was = self._seen()
        if not self.agents and not actions:
            return {}, {}, {}, {}, {}  # as wrappers do that count rounds
        if not self.agents:
            raise HipgError(
                f"{self.task_spec.task}: the episode is over: reset() comes before the next step()"
            )
        lived = was.info["alive"]
        step = self._now = self._env.step(gather(self._env, self._number, actions, lived[0].tolist()))
        terminated, truncated = (bool(flag[0]) for flag in death.ends(self.task_spec, step))
        agents, alive = self.agents, step.info["alive"][0].tolist()
        leaves = {a: terminated or (self._remove and not alive[self._number[a]]) for a in agents}
        timeout = {a: truncated and not leaves[a] for a in agents}
        paid = death.pay(self.task_spec, step, lived)[0].tolist()
        self.agents = [a for a in agents if not (leaves[a] or timeout[a])]
        if self._live:
            self._live.see(self._env.rows[0])
        observations, infos = self._look(step, agents)
        return observations, {a: paid[self._number[a]] for a in agents}, leaves, timeout, infos

    def state(self) -> Float[np.ndarray, "S"]:
        """The joint state, for central critics."""
        return self._seen().info["state"][0].copy()

    def render(self) -> UInt8[np.ndarray, "height width 3"] | None:
        """The world as it is, with ``rgb_array``; a window shows it by itself.

        Raises:
            RenderError: no episode has begun, or no OpenGL works here.
        """
        return self._live.picture() if self._live and self.render_mode == "rgb_array" else None

    def close(self) -> None:
        """Refuse further use."""
        self._env.close()
        self._now, self.agents = None, []
        if self._live:
            self._live.close()

    def _seen(self) -> Step:
        if self._now is None:
            raise HipgError(
                f"{self.task_spec.task}: reset() comes first: no episode has begun, or it is closed"
            )
        return self._now

    def _look(self, step: Step, agents: list[str]) -> tuple[Told, Told]:
        """Observations and infos."""
        rows, info, number = step.observation[0], step.info, self._number
        alive, health = info["alive"][0].tolist(), info["health"][0].tolist()
        infos = {a: {"alive": alive[number[a]], "health": health[number[a]]} for a in agents}
        return {a: rows[number[a]] for a in agents}, infos


parallel_env = HipgParallelEnv
"""The way in, as PettingZoo's environments have it."""

for _name, _spec in tasks().items():
    pettingzoo.register(
        "parallel", f"hipg/{_name}-v{_spec.version}", f"{__name__}:parallel_env", kwargs={"task": _name}
    )
