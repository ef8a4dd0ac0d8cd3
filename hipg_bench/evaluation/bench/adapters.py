"""What each API adapter adds to a step of `BatchEnv`."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable, Mapping

import numpy as np
from jaxtyping import Float

from hipg_bench import registry
from hipg_bench.evaluation.bench.timing import Contender, in_turn
from hipg_bench.spec import TaskSpec

_POOL = 16
"""Actions drawn beforehand, so that drawing is not timed."""
_BATCH = "BatchEnv"
_TURN = 50
"""Steps of a turn: an episode of the drones, so that resets are in every turn."""


@dataclasses.dataclass(frozen=True)
class Overhead:
    """Of one adapter; numbers are None where it was left out.

    Attributes:
        adapter, task, num_envs, threads: what was run.
        step_us: per step of all worlds, resets included.
        batch_us: the same of `BatchEnv`.
        overhead: the first over the second - 1, the median of the rounds' own ratios.
        left_out: why, empty where it was not.
    """

    adapter: str
    task: str
    num_envs: int
    threads: int
    step_us: float | None = None
    batch_us: float | None = None
    overhead: float | None = None
    left_out: str = ""


Actions = Float[np.ndarray, "K B N A"]
Stepper = Callable[[], object]
"""One step of all worlds, with a reset where the API asks for one."""


def overheads(spec: TaskSpec, num_envs: int, threads: int, seconds: float) -> list[Overhead]:
    """Step every adapter, and the worlds without any, in turn.

    Args:
        spec: the task.
        num_envs: B; with more than one, adapters of one world are not asked.
        threads: physics threads of all worlds, 0 for all cores; one world has one.
        seconds: for all together.
    """
    env = registry.make(spec, num_envs, threads=threads)
    env.reset()
    actions = np.random.default_rng(0).uniform(-1, 1, (_POOL, num_envs, env.num_agents, env.action_size))
    pool = itertools.cycle(actions)
    contenders = {_BATCH: Contender(lambda: env.step(next(pool)))}
    left_out: dict[str, str] = {}
    adapters = {**_ONE_WORLD, **_MANY_WORLDS} if num_envs == 1 else _MANY_WORLDS
    for adapter, opened in adapters.items():
        try:
            contenders[adapter] = Contender(opened(spec, actions, threads))
        except ImportError as error:
            left_out[adapter] = str(error)
    times = in_turn(contenders, seconds, calls=_TURN)
    measured = [
        Overhead(
            adapter, spec.task, num_envs, threads,
            step_us=1e6 * times.median(adapter),
            batch_us=1e6 * times.median(_BATCH),
            overhead=times.ratio(adapter, _BATCH) - 1,
        )
        for adapter in contenders if adapter != _BATCH
    ]  # fmt: skip
    return measured + [
        Overhead(adapter, spec.task, num_envs, threads, left_out=why) for adapter, why in left_out.items()
    ]


def _by_agent(actions: Actions) -> itertools.cycle[dict[str, np.ndarray]]:
    """Of one world, by name."""
    return itertools.cycle([{f"agent_{i}": one for i, one in enumerate(action[0])} for action in actions])


def _pettingzoo(spec: TaskSpec, actions: Actions, _threads: int) -> Stepper:
    from hipg_bench.adapters.pettingzoo import parallel_env

    env, told = parallel_env(spec), _by_agent(actions)

    def step() -> None:
        if not env.agents:
            env.reset()
        env.step(next(told))

    return step


def _rllib(spec: TaskSpec, actions: Actions, _threads: int) -> Stepper:
    from hipg_bench.adapters.rllib import HipgMultiAgentEnv

    env, told = HipgMultiAgentEnv({"task": spec}), _by_agent(actions)
    env.reset()

    def step() -> None:
        _, _, terminated, truncated, _ = env.step(next(told))
        if terminated["__all__"] or truncated["__all__"]:
            env.reset()

    return step


def _gymnasium(spec: TaskSpec, actions: Actions, _threads: int) -> Stepper:
    from hipg_bench.adapters.gymnasium import HipgEnv

    env, told = HipgEnv(spec), itertools.cycle(actions.reshape(len(actions), -1))
    env.reset()

    def step() -> None:
        _, _, terminated, truncated, _ = env.step(next(told))
        if terminated or truncated:
            env.reset()

    return step


def _dm_env(spec: TaskSpec, actions: Actions, _threads: int) -> Stepper:
    from hipg_bench.adapters.dm_env import HipgEnvironment

    # a step after a LAST one is a reset
    env, told = HipgEnvironment(spec), itertools.cycle([list(action[0]) for action in actions])
    return lambda: env.step(next(told))


def _gymnasium_vector(spec: TaskSpec, actions: Actions, threads: int) -> Stepper:
    from hipg_bench.adapters.gymnasium_vector import HipgVectorEnv

    env = HipgVectorEnv(spec, actions.shape[1], "SameStep", threads=threads)
    told = itertools.cycle(actions.reshape(*actions.shape[:2], -1))
    env.reset()
    return lambda: env.step(next(told))


def _sb3(spec: TaskSpec, actions: Actions, threads: int) -> Stepper:
    from hipg_bench.adapters.sb3 import HipgVecEnv

    env = HipgVecEnv(spec, actions.shape[1], threads=threads)
    told = itertools.cycle(actions.reshape(len(actions), -1, actions.shape[-1]))
    env.reset()

    def step() -> None:
        env.step(next(told))

    return step


def _torchrl(spec: TaskSpec, actions: Actions, threads: int) -> Stepper:
    import torch

    from hipg_bench.adapters.torchrl import HipgEnv

    env = HipgEnv(spec, actions.shape[1], threads=threads)
    told = itertools.cycle([torch.from_numpy(action).float() for action in actions])
    seen = [env.reset()]

    def step() -> None:
        _, seen[0] = env.step_and_maybe_reset(seen[0].set(("agents", "action"), next(told)))

    return step


Adapter = Callable[[TaskSpec, Actions, int], Stepper]

_ONE_WORLD: Mapping[str, Adapter] = {
    "pettingzoo": _pettingzoo, "rllib": _rllib, "gymnasium": _gymnasium, "dm_env": _dm_env,
}  # fmt: skip
_MANY_WORLDS: Mapping[str, Adapter] = {
    "gymnasium vector": _gymnasium_vector, "stable-baselines3": _sb3, "torchrl": _torchrl,
}  # fmt: skip
"""Adapters that step B worlds at once."""
