"""The team as one agent: its spaces, its action, and what it is told beside its observation."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium.envs.registration import EnvSpec
from gymnasium.spaces import Box
from jaxtyping import Float

from hipg_bench.arguments import numbers
from hipg_bench.env import BatchEnv, Step
from hipg_bench.errors import SpecError
from hipg_bench.rendering.live import SIZE
from hipg_bench.spec import TaskSpec


def joint_spaces(env: BatchEnv) -> tuple[Box, Box]:
    """Observation (N * O,) and action (N * A,), the agents' one after another."""
    low, high = (np.tile(ends, env.num_agents) for ends in env.layout.observation.limits)
    seen = Box(low, high)
    return seen, Box(-1.0, 1.0, (env.num_agents * env.action_size,))


def check_drawing(task: str, overrides: Mapping[str, Any]) -> None:
    """Refuse sizes of pictures, which other environments of Gymnasium take, with what to do instead.

    Raises:
        SpecError: there is one.
    """
    for name in ("width", "height", "camera_name", "camera_id"):
        if name in overrides:
            width, height = SIZE
            raise SpecError(
                f"{task}: {name!r} is refused: pictures are {width} x {height}, from a camera that follows "
                f"the team; `hipg-bench video --width` makes films of any size"
            )


def split_action(env: BatchEnv, action: Any, lead: tuple[int, ...]) -> Float[np.ndarray, "B N A"]:
    """Return a joint action agent by agent.

    Args:
        env: the worlds.
        action: (*lead, N * A).
        lead: ``(B,)``, or nothing where there is one world.

    Raises:
        ActionError: not numbers of this shape.
    """
    size = env.action_size
    shape, note = (*lead, env.num_agents * size), f", {size} for each agent in turn"
    return numbers(action, env.spec.task, shape, note=note).reshape(env.num_envs, env.num_agents, size)


def told_horizon(registered: EnvSpec | None, spec: TaskSpec) -> EnvSpec | None:
    """Gymnasium's spec of an environment, which says how long episodes are: wrappers ask for it.

    It is not registered so: Gymnasium would end episodes there, whatever ``horizon`` is asked for.
    """
    if registered is None or registered.max_episode_steps is not None:
        return registered
    told = copy.copy(registered)
    told.max_episode_steps = spec.horizon
    return told


def joint_info(step: Step) -> dict[str, np.ndarray]:
    """Joint ``state`` (B, S), who is ``alive`` (B, N), and the reward's terms (B,), ``reward_<term>``."""
    terms = {f"reward_{name}": value for name, value in step.info["terms"].items()}
    return {"state": step.info["state"], "alive": step.info["alive"], **terms}
