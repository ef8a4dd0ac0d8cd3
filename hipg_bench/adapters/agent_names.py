"""Agents by name: what APIs with one dict entry per agent are handed, checked."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, cast

import numpy as np
from jaxtyping import Float

from hipg_bench.arguments import numbers
from hipg_bench.env import BatchEnv
from hipg_bench.errors import ActionError, UnknownNameError, hint
from hipg_bench.spec import TaskSpec


def numbered(spec: TaskSpec) -> dict[str, int]:
    """``agent_0`` to ``agent_{N-1}``, with their numbers."""
    return {f"agent_{i}": i for i in range(spec.num_agents)}


def checked_name(spec: TaskSpec, agent: Any, number: Mapping[str, int]) -> str:
    """Return the name of an agent of the team.

    Raises:
        UnknownNameError: it is no such name; the message holds the nearest.
    """
    if agent not in number:
        raise UnknownNameError(f"{spec.task}: no agent {agent!r}{hint(str(agent), number)}")
    return agent


def gather(
    env: BatchEnv, number: Mapping[str, int], actions: Any, alive: Sequence[bool]
) -> Float[np.ndarray, "1 N A"]:
    """Stack the actions of one world's agents; what the dead are told is left out.

    Args:
        env: the world.
        number: every agent's.
        actions: (A,) by name.
        alive: (N,) who needs one.

    Raises:
        UnknownNameError: a name that is not in the team.
        ActionError: a living agent without an action, or with one that is not A numbers.
    """
    task, shape = env.spec.task, (env.action_size,)
    if not isinstance(actions, Mapping):
        raise ActionError(
            f"{task}: a dict with an action for each live agent is allowed, got {actions!r:.80}"
        )
    actions = cast(Mapping[Any, Any], actions)
    for agent in [name for name in actions if name not in number]:
        checked_name(env.spec, agent, number)
    out = np.zeros((1, env.num_agents, env.action_size))
    for agent, i in number.items():
        if not alive[i]:
            continue
        if agent not in actions:
            raise ActionError(f"{task}: {agent} is alive and needs an action of shape {shape}, it has none")
        out[0, i] = numbers(actions[agent], task, shape, whose=f" for {agent}")
    return out
