"""What a family must say, so that `BatchEnv.step` can run it."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any, Protocol, runtime_checkable

import mujoco
import numpy as np
from jaxtyping import Bool, Float, Int

from hipg_bench.layout import TaskLayout
from hipg_bench.mechanics.few import few
from hipg_bench.sim import Sim

EVERY = slice(None)
"""All environments, as an index."""

Rows = slice | Int[np.ndarray, "n"]
"""Which environments a snapshot covers."""


@dataclasses.dataclass(frozen=True)
class Harm:
    """What one control step does to the agents, before the health law is applied.

    Attributes:
        exposure: (B, N) exposure gained, nats, >= 0.
        fatal: (B, N) killed outright.
        cause: (B, N) index into the family's ``causes``, for those who die in this step.
    """

    exposure: Float[np.ndarray, "B N"]
    fatal: Bool[np.ndarray, "B N"]
    cause: Int[np.ndarray, "B N"]

    @property
    def cases(self) -> tuple[Int[np.ndarray, "n"], ...]:
        """Worlds and agents of the n that came to any."""
        return few((self.exposure > 0) | self.fatal)


@runtime_checkable
class Family(Protocol):
    """Physics and rules of a family, for one spec.

    A ``Snapshot`` is the family's dataclass of named arrays (n, ...), which are its own; it has a field
    ``health`` (n, N), into which deaths of the step are written. Everything that evolves lives in the
    simulation's rows, so a family object holds only constants.

    Attributes:
        layout: observation, action and joint state.
        fields: what an episode remembers in ``userdata`` beside health: name to size.
        chance_size: uniform numbers the family draws per episode, at reset only.
        causes: names of what kills.
        metrics: names of what ``measure`` returns.
        physics_steps: physics steps per control step.
    """

    layout: TaskLayout
    fields: Mapping[str, int]
    chance_size: int
    causes: tuple[str, ...]
    metrics: tuple[str, ...]
    physics_steps: int

    def scene(self) -> mujoco.MjSpec:
        """Compose the world, agent i's actuators in group i, what only a camera sees in `VISUAL_GROUP`."""
        ...

    def reset(self, sim: Sim, ids: Int[np.ndarray, "n"], chance: Float[np.ndarray, "n K"]) -> None:
        """Lay out worlds ``ids`` from uniform numbers; health and toughness are already drawn."""
        ...

    def act(self, sim: Sim, was: Any, action: Float[np.ndarray, "B N A"]) -> None:
        """Write the actuators' inputs (and forces that mechanics add), in the state ``was``."""
        ...

    def read(self, sim: Sim, rows: Rows = EVERY) -> Any:
        """Snapshot of worlds ``rows``."""
        ...

    def renew(self, sim: Sim, now: Any, ids: Int[np.ndarray, "n"], fresh: Any) -> Any:
        """Snapshot of all worlds, of which ``ids`` have just begun anew, as their snapshot ``fresh`` says."""
        ...

    def harm(self, was: Any, now: Any) -> Harm:
        """What this step does to the agents."""
        ...

    def remember(self, sim: Sim, was: Any, now: Any) -> Any:
        """Write what the episode remembers, given the new health; return the snapshot that knows it."""
        ...

    def reward(self, was: Any, now: Any) -> dict[str, Float[np.ndarray, "B"]]:
        """Terms of the team reward, before weights."""
        ...

    def terminated(self, now: Any) -> tuple[Bool[np.ndarray, "B"], str | np.ndarray]:
        """Episodes that the rules end now, and the reason's name: one for all, or (B,) of them."""
        ...

    def observe(self, now: Any) -> Float[np.ndarray, "n N O"]:
        """What agents see, before the dead are blinded."""
        ...

    def state(self, now: Any) -> Float[np.ndarray, "n S"]:
        """What a central critic sees."""
        ...

    def measure(self, sim: Sim, ids: Int[np.ndarray, "n"], now: Any) -> dict[str, Float[np.ndarray, "n"]]:
        """Metrics of episodes that end; ``now`` covers all worlds."""
        ...
