"""Random play that does not depend on the batch: the tests' common driver."""

from __future__ import annotations

import numpy as np

from hipg_bench import BatchEnv, Step

KINDS = 3
"""Ways to act: white noise, a push held for the episode, and full power along it."""

CASUALTY_AT = 8
"""Control step at which every second episode loses one agent, whatever the task."""


def action(env: BatchEnv, episode_id: int, elapsed: int) -> np.ndarray:
    """(N, A) action that depends on the episode and the time in it alone."""
    size = (env.num_agents, env.action_size)
    noise = np.random.Generator(np.random.Philox(key=7, counter=[0, 0, elapsed + 1, episode_id]))
    push = np.random.Generator(np.random.Philox(key=7, counter=[0, 0, 0, episode_id])).uniform(-1, 1, size)
    kind = episode_id % KINDS
    if kind == 0:
        return noise.uniform(-1, 1, size)
    return np.clip(push + noise.normal(0, 0.2, size), -1, 1) if kind == 1 else np.sign(push)


def actions(env: BatchEnv, step: Step) -> np.ndarray:
    """(B, N, A) random actions for what ``step`` shows."""
    pairs = zip(step.info["episode_id"].tolist(), step.info["elapsed"].tolist(), strict=True)
    return np.stack([action(env, episode, elapsed) for episode, elapsed in pairs])


def strike(env: BatchEnv, step: Step) -> Step:
    """Kill one agent in every second episode at `CASUALTY_AT`, so that all tasks show deaths."""
    episode, elapsed = step.info["episode_id"], step.info["elapsed"]
    for world in np.flatnonzero((elapsed == CASUALTY_AT) & (episode % 2 == 1)).tolist():
        victim = int(episode[world]) // 2 % env.num_agents
        step = env.load_rows(np.array([world]), env.fork(env.rows[[world]], {victim: 0.0}))
    return step


def play(env: BatchEnv, step: Step, steps: int) -> list[Step]:
    """Go on from ``step`` with random actions and casualties; returns ``steps`` further steps."""
    out: list[Step] = []
    for _ in range(steps):
        step = env.step(actions(env, strike(env, step)))
        out.append(step)
    return out


def flat(step: Step) -> dict[str, np.ndarray]:
    """Every array of a step by name; those of ``info`` as ``info.terms.distance``."""
    out = {name: getattr(step, name) for name in ("observation", "reward", "terminated", "truncated")}
    for name, value in step.info.items():
        if isinstance(value, dict):
            out |= {f"info.{name}.{key}": array for key, array in value.items()}
        else:
            out[f"info.{name}"] = value
    return out


def same(a: np.ndarray, b: np.ndarray) -> bool:
    """Bit for bit (NaN is equal to NaN); strings by value."""
    if a.dtype.kind == "U":
        return bool(np.array_equal(a, b))
    return a.shape == b.shape and a.dtype == b.dtype and a.tobytes() == b.tobytes()


def outcomes(env: BatchEnv, first: Step, steps: list[Step]) -> dict[tuple[int, int], dict[str, np.ndarray]]:
    """What each (episode, control step) led to, by the names of `flat`; new episodes' views apart."""
    out: dict[tuple[int, int], dict[str, np.ndarray]] = {}
    was = first
    for step in steps:
        keys = zip(was.info["episode_id"].tolist(), was.info["elapsed"].tolist(), strict=True)
        done = step.terminated | step.truncated
        arrays = {name: array for name, array in flat(step).items() if name not in _OF_THE_ENDED}
        ended = np.flatnonzero(done).tolist()
        for world, key in enumerate(keys):
            # after an ending some belong to the next episode, whose number depends on the batch
            kept = arrays.keys() - _OF_THE_NEXT if done[world] else arrays.keys()
            out[key] = {name: arrays[name][world].copy() for name in kept}
            if done[world]:
                k = ended.index(world)
                out[key] |= {name: step.info[name][k] for name in ("final_observation", "final_state")}
        was = step
    return out


_OF_THE_NEXT = {
    "observation", "info.state", "info.health", "info.alive", "info.episode_id", "info.elapsed",
}  # fmt: skip
_OF_THE_ENDED = {"info.final_observation", "info.final_state", "info.final_rows"}
