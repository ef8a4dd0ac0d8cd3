"""What death means where agents are paid one by one: the rules that adapters which keep the dead share.

A dead agent stays in the team to the end of the episode: it sees its own health 0 and zeros, and what it is
told is ignored. It is paid for the step in which it dies and, unless the task says ``reward_dead = "team"``,
no more.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

from hipg_bench.env import Step
from hipg_bench.spec import TaskSpec


def pay(spec: TaskSpec, step: Step, lived: Bool[np.ndarray, "B N"]) -> Float[np.ndarray, "B N"]:
    """What each agent gets for a step.

    Args:
        spec: the task.
        step: what the worlds returned.
        lived: who was alive before it.
    """
    return np.where(lived | (spec.reward_dead == "team"), step.reward[:, None], 0.0)


def ends(spec: TaskSpec, step: Step) -> tuple[Bool[np.ndarray, "B"], Bool[np.ndarray, "B"]]:
    """Terminated and truncated: as the task says, and terminated where nobody is left to be paid."""
    if spec.reward_dead == "team":
        return step.terminated, step.truncated
    lost = ~step.info["final_alive"].any(axis=1)
    return step.terminated | lost, step.truncated & ~lost
