"""Open-loop baselines: no action, random actions, and fixed sequences. On a good task they score about 0."""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Bool, Float, Int

_RANDOM, _CONSTANT, _TIME_ONLY = 0x72616E64, 0x636F6E73, 0x74696D65
"""Second words of the Philox keys: no two kinds of policy share a stream, nor any with an environment."""
_BLOCK = 64
"""Steps drawn at once by `Random`."""


class Zero:
    """No-op baseline."""

    privileged = False

    def __init__(self, action_size: int) -> None:
        self._action_size = action_size

    def initial_state(self, seed: int, episode_id: Int[np.ndarray, "B"], num_agents: int) -> None:
        """Remember nothing."""

    def act(
        self, seen: np.ndarray, memory: None, alive: Bool[np.ndarray, "B N"]
    ) -> tuple[Float[np.ndarray, "B N A"], None]:
        """Zero for all."""
        return np.zeros((*alive.shape, self._action_size)), memory


@dataclasses.dataclass(frozen=True)
class _Draws:
    """Where a random team stands: which episodes, which step, and the actions drawn for steps around it."""

    seed: int
    episode_id: Int[np.ndarray, "B"]
    step: int
    drawn: Float[np.ndarray, "B block N A"] | None


class Random:
    """Uniform in [-1, 1], drawn from (seed, episode id, step) alone: the anchor at score 0."""

    privileged = False

    def __init__(self, action_size: int) -> None:
        self._action_size = action_size

    def initial_state(self, seed: int, episode_id: Int[np.ndarray, "B"], num_agents: int) -> _Draws:
        """Remember the episodes; nothing is drawn yet."""
        return _Draws(seed, np.asarray(episode_id), 0, None)

    def act(
        self, seen: np.ndarray, memory: _Draws, alive: Bool[np.ndarray, "B N"]
    ) -> tuple[Float[np.ndarray, "B N A"], _Draws]:
        """One row of the block of steps drawn last."""
        drawn = memory.drawn
        if drawn is None or memory.step % _BLOCK == 0:
            drawn = self._draw(memory, alive.shape[1])
        return drawn[:, memory.step % _BLOCK], dataclasses.replace(memory, step=memory.step + 1, drawn=drawn)

    def _draw(self, memory: _Draws, num_agents: int) -> Float[np.ndarray, "B block N A"]:
        block = memory.step // _BLOCK
        return np.stack([
            np.random.Generator(
                np.random.Philox(key=[memory.seed, _RANDOM], counter=[0, 0, block, episode])
            ).uniform(-1.0, 1.0, (_BLOCK, num_agents, self._action_size))
            for episode in memory.episode_id.tolist()
        ])  # fmt: skip


class Constant:
    """Each agent holds one action, drawn once for all episodes by ``variant``: a probe."""

    privileged = False

    def __init__(self, action_size: int, variant: int = 0) -> None:
        self._action_size = action_size
        self._variant = variant

    def initial_state(
        self, seed: int, episode_id: Int[np.ndarray, "B"], num_agents: int
    ) -> Float[np.ndarray, "N A"]:
        """The team's action."""
        chance = np.random.Generator(np.random.Philox(key=[self._variant, _CONSTANT]))
        return chance.uniform(-1.0, 1.0, (num_agents, self._action_size))

    def act(
        self, seen: np.ndarray, memory: Float[np.ndarray, "N A"], alive: Bool[np.ndarray, "B N"]
    ) -> tuple[Float[np.ndarray, "B N A"], Float[np.ndarray, "N A"]]:
        """The same in every world and step."""
        return np.broadcast_to(memory, (len(alive), *memory.shape)).copy(), memory


class TimeOnly:
    """An open loop: one fixed sequence of actions for all episodes, each held for some steps: a probe.

    What such a policy can score is scored without looking at the world.
    """

    privileged = False

    def __init__(self, action_size: int, variant: int = 0, hold: int = 5) -> None:
        self._action_size = action_size
        self._variant = variant
        self._hold = hold

    def initial_state(self, seed: int, episode_id: Int[np.ndarray, "B"], num_agents: int) -> int:
        """Remember the time, in steps."""
        return 0

    def act(
        self, seen: np.ndarray, memory: int, alive: Bool[np.ndarray, "B N"]
    ) -> tuple[Float[np.ndarray, "B N A"], int]:
        """What the sequence says for this step."""
        counter = [0, 0, 0, memory // self._hold]
        chance = np.random.Generator(np.random.Philox(key=[self._variant, _TIME_ONLY], counter=counter))
        action = chance.uniform(-1.0, 1.0, (alive.shape[1], self._action_size))
        return np.broadcast_to(action, (len(alive), *action.shape)).copy(), memory + 1
