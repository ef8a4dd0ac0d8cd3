"""One way to drive every adapter: what it shows of one world, as arrays over all N agents.

A driver lives in ``drive_<library>.py`` and has one line in `DRIVERS`. It imports its library at its top;
`open_adapter` skips the test where that library is not installed, so the same tests run in any environment
that has some of the adapters (``pytest tests/adapters -k rllib``).
"""

from __future__ import annotations

import dataclasses
import importlib
from collections.abc import Iterable, Mapping
from typing import Any, Literal, Protocol

import numpy as np
import pytest

Mode = Literal["remove", "ghost", "joint"]
"""What becomes of the dead: they leave; they stay, blind and unpaid; one learner acts for the team."""


@dataclasses.dataclass(frozen=True)
class Seen:
    """What an adapter returned from ``reset`` or ``step``.

    Attributes:
        observation: (N, O) float32, NaN rows for agents that the adapter did not report.
        reward: (N,) what each agent was paid, NaN for those not reported; the team's in joint adapters.
        terminated, truncated: (N,) as told to each agent, False for those not reported.
        reported: (N,) the agent appears in what was returned.
        live: (N,) the adapter still lists the agent, and expects an action of it.
        alive: (N,) the agent's health is above 0, as the adapter tells it.
        state: (S,) joint state, None where the adapter has none.
        over: the episode is over; adapters that start the next one at once show the one that ended all the
            same.
        info_keys: the different sets of keys of the infos returned; one, always the same, is right.
    """

    observation: np.ndarray
    reward: np.ndarray
    terminated: np.ndarray
    truncated: np.ndarray
    reported: np.ndarray
    live: np.ndarray
    alive: np.ndarray
    state: np.ndarray | None
    over: bool
    info_keys: frozenset[tuple[str, ...]]


class Adapter(Protocol):
    """One world behind one API.

    Attributes:
        dead: what becomes of the dead.
    """

    dead: Mode

    def __init__(self, task: str, seed: int, **overrides: Any) -> None: ...

    def reset(self, seed: int | None = None) -> Seen:
        """Start the next episode; with a seed, episode 0 of that seed."""
        ...

    def step(self, action: np.ndarray) -> Seen:
        """Hand over all N rows of (N, A), those of the dead too wherever the API takes them."""
        ...

    def close(self) -> None:
        """Give up what it holds."""
        ...


DRIVERS: Mapping[str, tuple[str, str]] = {
    "pettingzoo-remove": ("pettingzoo", "drive_pettingzoo:Remove"),
    "pettingzoo-ghost": ("pettingzoo", "drive_pettingzoo:Ghost"),
    "gymnasium": ("gymnasium", "drive_gymnasium:Joint"),
    "gymnasium-same-step": ("gymnasium", "drive_gymnasium:SameStep"),
    "gymnasium-next-step": ("gymnasium", "drive_gymnasium:NextStep"),
    "gymnasium-disabled": ("gymnasium", "drive_gymnasium:Disabled"),
    "sb3": ("stable_baselines3", "drive_sb3:Slots"),
    "dm_env": ("dm_env", "drive_dm_env:Lists"),
    "dm_env-joint": ("dm_env", "drive_dm_env:Joint"),
    "torchrl": ("torchrl", "drive_torchrl:Group"),
    "rllib": ("ray", "drive_rllib:Leaving"),
}
"""Adapter to the library it needs and its driver."""

ADAPTERS = tuple(DRIVERS)
"""What the truth table and the agreement tests go through."""


def open_adapter(name: str, task: str, seed: int = 0, **overrides: Any) -> Adapter:
    """One world of a task behind the adapter ``name``; skips the test without its library."""
    library, driver = DRIVERS[name]
    pytest.importorskip(library)
    module, kind = driver.split(":")
    return getattr(importlib.import_module(module), kind)(task, seed, **overrides)


def over_agents(values: Mapping[str, Any], count: int, shape: tuple[int, ...] = ()) -> np.ndarray:
    """A dict by agent name as (N, *shape) float, NaN for agents that it does not hold."""
    out = np.full((count, *shape), np.nan, np.float32 if shape else np.float64)
    for agent, value in values.items():
        out[int(agent.removeprefix("agent_"))] = value
    return out


def keys_of(infos: Iterable[Mapping[str, Any]]) -> frozenset[tuple[str, ...]]:
    """The different sets of keys among infos."""
    return frozenset(tuple(sorted(info)) for info in infos)
