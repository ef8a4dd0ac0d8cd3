"""What a policy must offer, so that it can be evaluated, filmed and submitted."""

from __future__ import annotations

from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float, Int


@runtime_checkable
class Policy(Protocol):
    """A pure object: what it remembers between steps travels through ``memory``.

    The same inputs give the same actions, and world b's actions depend on world b's inputs alone:
    results must be byte-identical however many worlds are run together.

    Attributes:
        privileged: it acts on the joint state instead of observations, and is never ranked.
    """

    privileged: bool

    def initial_state(self, seed: int, episode_id: Int[np.ndarray, "B"], num_agents: int) -> Any:
        """Return the memory with which B episodes begin.

        Args:
            seed: the evaluation's; with the episode id it fixes all chance.
            episode_id: (B,).
            num_agents: N.
        """
        ...

    def act(
        self,
        seen: Float[np.ndarray, "B N O"] | Float[np.ndarray, "B S"],
        memory: Any,
        alive: Bool[np.ndarray, "B N"],
        /,
    ) -> tuple[Float[np.ndarray, "B N A"], Any]:
        """Choose every agent's action.

        Args:
            seen: observations (B, N, O), or joint states (B, S) if privileged.
            memory: what `initial_state` or the step before returned; it is left as it was.
            alive: (B, N); what dead agents are told is ignored.

        Returns:
            (B, N, A) float64 actions in [-1, 1], and the new memory.
        """
        ...
