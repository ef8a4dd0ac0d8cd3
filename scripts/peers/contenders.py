"""What is compared: each function builds one contender, with its library imported inside.

Actions are drawn beforehand for all; what a contender compiles or allocates is done before the clock runs.
"""

from __future__ import annotations

import dataclasses
import importlib.metadata
import itertools
import os
import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

POOL = 16
"""Different actions."""


@dataclasses.dataclass(frozen=True)
class Contender:
    """Something that steps.

    Attributes:
        run: does some steps; returns how many, summed over worlds, or over agents where samples are counted.
        settings: everything that a reader must know.
    """

    run: Callable[[], int]
    settings: dict[str, Any]


def cores() -> int:
    """Cores that this process may run on."""
    return len(os.sched_getaffinity(0))


def versions(*packages: str) -> dict[str, str]:
    """Installed versions."""
    return {package: importlib.metadata.version(package) for package in packages}


def fastest_threads(run: Callable[[], object], seconds: float) -> int:
    """Set torch to one thread or to all, whichever is faster here; return which."""
    import torch

    calls: dict[int, float] = {}
    for count in {1, cores()}:
        torch.set_num_threads(count)
        run()
        done, started = 0, time.perf_counter()
        while time.perf_counter() - started < seconds:
            run()
            done += 1
        calls[count] = done / (time.perf_counter() - started)
    best = max(calls, key=calls.__getitem__)
    torch.set_num_threads(best)
    return best


def hipg(task: str, num_envs: int) -> Contender:
    """`BatchEnv`: observation, state, reward, health, metrics, autoreset."""
    import hipg_bench

    env = hipg_bench.make(task, num_envs)
    env.reset()
    shape = (POOL, num_envs, env.num_agents, env.action_size)
    pool = itertools.cycle(np.random.default_rng(0).uniform(-1, 1, shape))

    def run() -> int:
        env.step(next(pool))
        return num_envs

    return Contender(run, {
        "agents": env.num_agents, "worlds": num_envs, "threads": cores(), "horizon": env.spec.horizon,
        "autoreset": True, "actions": "continuous", "versions": versions("hipg-bench", "mujoco", "numpy"),
    })  # fmt: skip


def vmas(agents: int, num_envs: int) -> Contender:
    """VMAS simple_spread, vectorised by torch on the CPU."""
    import torch
    import vmas as library

    torch.set_grad_enabled(False)
    env = library.make_env("simple_spread", num_envs=num_envs, n_agents=agents, device="cpu", seed=0)
    env.reset()
    pool = itertools.cycle([env.get_random_actions() for _ in range(POOL)])

    def run() -> int:
        env.step(next(pool))
        return num_envs

    threads = fastest_threads(run, 2.0)
    return Contender(run, {
        "agents": agents, "worlds": num_envs, "threads": threads, "horizon": None, "autoreset": False,
        "actions": "continuous", "gradients": False, "versions": versions("vmas", "torch"),
    })  # fmt: skip


def jaxmarl(agents: int, num_envs: int) -> Contender:
    """JaxMARL MPE_simple_spread_v3: jit of a scan over vmapped steps, as its documentation has it."""
    import jax
    import jaxmarl as library

    steps = 50
    env = library.make("MPE_simple_spread_v3", num_agents=agents, num_landmarks=agents)
    key = jax.random.PRNGKey(0)
    actions = jax.random.randint(key, (steps, agents, num_envs), 0, 5)

    def advance(carry: Any, action: jax.Array) -> tuple[Any, None]:
        key, state, _ = carry
        key, own = jax.random.split(key)
        told = dict(zip(env.agents, action, strict=True))
        seen, state, reward, done, _ = jax.vmap(env.step)(jax.random.split(own, num_envs), state, told)
        # carried on, so that no part of a step is optimised away
        return (key, state, (seen, reward, done)), None

    @jax.jit
    def scan(carry: Any) -> Any:
        return jax.lax.scan(advance, carry, actions)[0]

    _, state = jax.jit(jax.vmap(env.reset))(jax.random.split(key, num_envs))
    keys = jax.random.split(key, num_envs)
    shown = jax.vmap(env.step)(keys, state, dict(zip(env.agents, actions[0], strict=True)))
    carry = [scan((key, state, (shown[0], shown[2], shown[3])))]

    def run() -> int:
        carry[0] = jax.block_until_ready(scan(carry[0]))
        return steps * num_envs

    return Contender(run, {
        "agents": agents, "worlds": num_envs, "threads": f"XLA's own, {cores()} cores",
        "horizon": env.max_steps, "autoreset": True, "actions": "discrete", "steps per jitted scan": steps,
        "versions": versions("jaxmarl", "jax", "jaxlib"),
    })  # fmt: skip


def parallel(env: Any, settings: Mapping[str, Any]) -> Contender:
    """One world behind PettingZoo's parallel API; it is reset when nobody is left."""
    env.reset(seed=0)
    names = env.possible_agents
    pool = itertools.cycle([{name: env.action_space(name).sample() for name in names} for _ in range(POOL)])

    def run() -> int:
        for _ in range(10):
            if not env.agents:
                env.reset()
            env.step(next(pool))
        return 10

    return Contender(run, {"agents": len(names), "worlds": 1, "threads": 1, "autoreset": True, **settings})


def pettingzoo_walkers(walkers: int) -> Contender:
    """PettingZoo's multiwalker_v9; it has no batched form."""
    from pettingzoo.sisl import multiwalker_v9

    env = multiwalker_v9.parallel_env(n_walkers=walkers)
    return parallel(env, {"horizon": 500, "versions": versions("pettingzoo", "Box2D")})


def mamujoco() -> Contender:
    """MaMuJoCo's Ant of four agents with two joints each."""
    from gymnasium_robotics import mamujoco_v1

    env = mamujoco_v1.parallel_env("Ant", "4x2")
    return parallel(env, {"horizon": 1000, "versions": versions("gymnasium-robotics", "gymnasium", "mujoco")})


def hipg_pettingzoo(task: str) -> Contender:
    """Our PettingZoo adapter."""
    import hipg_bench
    from hipg_bench.adapters.pettingzoo import parallel_env

    horizon = hipg_bench.task_spec(task).horizon
    return parallel(
        parallel_env(task), {"horizon": horizon, "versions": versions("hipg-bench", "pettingzoo")}
    )


def hipg_mappo(task: str) -> Contender:
    """Whole training iterations of our MAPPO, min-health crediting included."""
    from hipg_bench.learning import torch_setup
    from hipg_bench.learning.mappo import Trainer
    from hipg_bench.learning.settings import Settings, recommended

    torch_setup.configure()  # as `hipg-bench train` does
    settings = recommended(task)
    if not isinstance(settings, Settings):
        raise TypeError(f"MAPPO's settings are compared, got {settings!r}")
    trainer = Trainer(settings)
    samples = settings.num_envs * settings.rollout * trainer.env.num_agents

    def run() -> int:
        trainer.iterate()
        return samples

    threads = fastest_threads(run, 1.0)
    return Contender(
        run, {**training(settings), "threads": threads, "versions": versions("hipg-bench", "torch")}
    )


def torchrl_mappo(task: str) -> Contender:
    """TorchRL's collector, GAE and clipped PPO loss on our task, through our TorchRL adapter."""
    from torchrl_mappo import Mappo

    from hipg_bench.learning.settings import Settings, recommended

    settings = recommended(task)
    if not isinstance(settings, Settings):
        raise TypeError(f"MAPPO's settings are compared, got {settings!r}")
    learner = Mappo(settings)
    threads = fastest_threads(learner.iterate, 1.0)
    return Contender(learner.iterate, {
        **training(settings), "threads": threads, "versions": versions("torchrl", "tensordict", "torch"),
    })  # fmt: skip


def training(settings: Any) -> dict[str, Any]:
    """What both learners share."""
    names = ("num_envs", "rollout", "epochs", "minibatches", "actor_hidden", "critic_hidden")
    return {name: getattr(settings, name) for name in names}


CONTENDERS: Mapping[str, Callable[[], Contender]] = {
    "hipg paper_nav-8": lambda: hipg("paper_nav-8", 1024),
    "VMAS simple_spread": lambda: vmas(8, 1024),
    "JaxMARL simple_spread": lambda: jaxmarl(8, 1024),
    "hipg multiwalker-3": lambda: hipg("multiwalker-3", 1024),
    "PettingZoo multiwalker, 3": lambda: pettingzoo_walkers(3),
    "hipg multiwalker-5": lambda: hipg("multiwalker-5", 1024),
    "PettingZoo multiwalker, 5": lambda: pettingzoo_walkers(5),
    "hipg hazard_nav-4, PettingZoo": lambda: hipg_pettingzoo("hazard_nav-4"),
    "hipg multiwalker-3, PettingZoo": lambda: hipg_pettingzoo("multiwalker-3"),
    "MaMuJoCo Ant 4x2": mamujoco,
    "hipg MAPPO": lambda: hipg_mappo("paper_nav-8"),
    "TorchRL MAPPO": lambda: torchrl_mappo("paper_nav-8"),
}
"""By name; built in a process of its own."""
