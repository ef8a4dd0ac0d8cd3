"""The team as one agent: its spaces, its action, and what it is told beside its observation."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium.spaces import Box
from jaxtyping import Float

from hipg_bench.env import BatchEnv, Step
from hipg_bench.errors import ActionError


def joint_spaces(env: BatchEnv) -> tuple[Box, Box]:
    """Observation (N * O,) and action (N * A,), the agents' one after another."""
    seen = Box(-np.inf, np.inf, (env.num_agents * env.observation_size,))
    return seen, Box(-1.0, 1.0, (env.num_agents * env.action_size,))


def split_action(env: BatchEnv, action: Any, lead: tuple[int, ...]) -> Float[np.ndarray, "B N A"]:
    """Return a joint action agent by agent.

    Args:
        env: the worlds.
        action: (*lead, N * A).
        lead: ``(B,)``, or nothing where there is one world.

    Raises:
        ActionError: not numbers of this shape.
    """
    action, size = np.asarray(action), env.action_size
    shape = (*lead, env.num_agents * size)
    if action.shape != shape or action.dtype.kind not in "fiub":
        raise ActionError(
            f"{env.spec.task}: numbers of shape {shape} are allowed, {size} for each agent in turn, "
            f"got {action.dtype} of shape {action.shape}"
        )
    return action.reshape(env.num_envs, env.num_agents, size)


def joint_info(step: Step) -> dict[str, np.ndarray]:
    """Joint ``state`` (B, S), who is ``alive`` (B, N), and the reward's terms (B,), ``reward_<term>``."""
    terms = {f"reward_{name}": value for name, value in step.info["terms"].items()}
    return {"state": step.info["state"], "alive": step.info["alive"], **terms}
