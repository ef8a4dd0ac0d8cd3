"""Episodes step by step, for offline learning: what was observed, done, paid, and who was alive.

An episode of T control steps has T + 1 observations, joint states, health values and alive masks, the last
of them after its last step, and T actions and rewards.
"""

from __future__ import annotations

import dataclasses
import re
import warnings
import zipfile
from collections.abc import Iterator, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from hipg_bench.env import BatchEnv, Step
from hipg_bench.errors import HipgError
from hipg_bench.evaluation.episodes import Advance, EvaluationJob, silent
from hipg_bench.evaluation.failures import close
from hipg_bench.paths import replacing
from hipg_bench.policies.policy import Policy
from hipg_bench.registry import make
from hipg_bench.spec import TaskSpec

SCHEMA = 1
"""Of the npz file; raised when one of its arrays changes its meaning."""
_AFTER = ("observation", "state", "health", "alive")
"""Arrays with a row more than there are steps."""
_MINARI_ID = re.compile(r"(?:[\w.-]+/)*[\w.-]+-v\d+")


@dataclasses.dataclass(frozen=True)
class Trajectory:
    """One episode of T control steps.

    Attributes:
        seed, episode_id: they and the actions fix the episode.
        observation: (T + 1, N, O); a dead agent's row is its health 0 and zeros.
        state: (T + 1, S) joint states.
        health: (T + 1, N), in [0, 1].
        alive: (T + 1, N).
        action: (T, N, A) as the policy gave them; those of dead agents had no effect.
        reward: (T,) the team's.
        terminated: the rules ended it, and not the horizon.
        end_reason: why it ended.
    """

    seed: int
    episode_id: int
    observation: Float[np.ndarray, "T1 N O"]
    state: Float[np.ndarray, "T1 S"]
    health: Float[np.ndarray, "T1 N"]
    alive: Bool[np.ndarray, "T1 N"]
    action: Float[np.ndarray, "T N A"]
    reward: Float[np.ndarray, "T"]
    terminated: bool
    end_reason: str


def trajectories(
    spec: TaskSpec, policy: Policy, job: EvaluationJob, advance: Advance = silent
) -> Iterator[Trajectory]:
    """Play the job's worlds and keep everything, episode by episode in the order of worlds.

    Args:
        spec: the task.
        policy: who plays; it is closed at the end.
        job: which worlds; they are those of the standard split.
        advance: told of progress, in episodes.

    Raises:
        AgentFailure: the policy's process failed.
    """
    try:
        for worlds in job.batches():
            seed = job.eval_seed(spec.task, worlds[0])
            ids = np.array([job.episode_id(world) for world in worlds])
            env = make(spec, len(worlds), seed, threads=job.threads, autoreset=False)
            yield from _play(env, policy, seed, ids, advance)
    finally:
        close(policy)


def _play(env: BatchEnv, policy: Policy, seed: int, ids: np.ndarray, advance: Advance) -> list[Trajectory]:
    """One episode in each world, all begun together."""
    step = env.reset(ids)
    memory = policy.initial_state(seed, ids, env.num_agents)
    after: dict[str, list[np.ndarray]] = {name: [] for name in _AFTER}
    actions: list[np.ndarray] = []
    rewards: list[np.ndarray] = []
    length = np.zeros(env.num_envs, int)
    ended: list[Step | None] = [None] * env.num_envs
    running = np.ones(env.num_envs, bool)
    _keep(after, step)
    while running.any():
        seen = step.info["state"] if policy.privileged else step.observation
        action, memory = policy.act(seen, memory, step.info["alive"])
        # a world that has ended is begun again: it is stepped beside the others, and not looked at
        step = env.step(action)
        actions.append(np.array(action, np.float64))
        rewards.append(step.reward)
        _keep(after, step)
        over = step.terminated | step.truncated
        length += running
        for b in np.flatnonzero(over & running).tolist():
            ended[b] = step
        running &= ~over
        advance(env.num_envs / env.spec.horizon)
        if over.any() and running.any():
            env.reset(worlds=np.flatnonzero(over))
    advance(env.num_envs * (1 - len(actions) / env.spec.horizon))
    found: list[Trajectory] = []
    for b, last in enumerate(ended):
        if last is None:
            raise HipgError(f"{env.spec.task}: world {b} did not end")
        steps = int(length[b])
        found.append(
            Trajectory(
                seed=seed,
                episode_id=int(ids[b]),
                **{name: np.stack([kept[b] for kept in after[name][: steps + 1]]) for name in _AFTER},
                action=np.stack([one[b] for one in actions[:steps]]),
                reward=np.array([one[b] for one in rewards[:steps]]),
                terminated=bool(last.terminated[b]),
                end_reason=str(last.info["end_reason"][b]),
            )
        )
    return found


def _keep(after: dict[str, list[np.ndarray]], step: Step) -> None:
    after["observation"].append(step.observation)
    for name in ("state", "health", "alive"):
        after[name].append(step.info[name])


def check_target(out: str) -> None:
    """Refuse a place that `write` could not write to, before anything is played.

    Raises:
        HipgError: it is neither the name of a new .npz file nor of a new Minari data set, or Minari is not
            installed.
    """
    if out.endswith(".npz"):
        if Path(out).exists():
            raise HipgError(f"{out} exists: choose another --out")
        return
    if not _MINARI_ID.fullmatch(out):
        raise HipgError(
            f"--out {out!r}: the name of a file that ends in .npz, or of a Minari data set such as "
            f"hipg/hazard_nav-4/expert-v0, is allowed"
        )
    if out in _minari().list_local_datasets():
        raise HipgError(f"there is a Minari data set {out} already: choose another --out")


def write(out: str, spec: TaskSpec, agent: str, episodes: Sequence[Trajectory]) -> None:
    """Write episodes to an .npz file or a Minari data set; see ``docs/guides/datasets.md``.

    Raises:
        HipgError: as `check_target` says.
    """
    check_target(out)
    if out.endswith(".npz"):
        _write_npz(Path(out), spec, agent, episodes)
    else:
        _write_minari(out, spec, agent, episodes)


def _write_npz(path: Path, spec: TaskSpec, agent: str, episodes: Sequence[Trajectory]) -> None:
    lengths = [len(one.reward) for one in episodes]
    arrays: dict[str, Any] = {
        name: np.concatenate([getattr(one, name) for one in episodes])
        for name in (*_AFTER, "action", "reward")
    }
    for name in ("seed", "episode_id", "terminated", "end_reason"):
        arrays[name] = np.array([getattr(one, name) for one in episodes])
    with replacing(path) as temporary:
        np.savez_compressed(
            temporary, **arrays, length=np.array(lengths), schema=SCHEMA, spec=spec.model_dump_json(),
            agent=agent, version=metadata.version("hipg-bench"),
        )  # fmt: skip


def read_npz(path: Path) -> tuple[TaskSpec, list[Trajectory]]:
    """Read what `write` wrote to an .npz file; nothing in it is executed.

    Raises:
        HipgError: it is no such file.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            data = {name: file[name] for name in file.files}
        spec = TaskSpec.model_validate_json(str(data["spec"]))
        if int(data["schema"]) != SCHEMA:
            raise HipgError(f"{path}: schema {SCHEMA} is allowed, got {int(data['schema'])}")
        steps = np.concatenate([[0], np.cumsum(data["length"])])
        return spec, [_episode(data, k, int(steps[k]), int(steps[k + 1])) for k in range(len(steps) - 1)]
    except (ValueError, KeyError, IndexError, EOFError, zipfile.BadZipFile) as error:
        raise HipgError(f"{path} holds no episodes written by hipg-bench: {error}") from error


def _episode(data: dict[str, np.ndarray], k: int, first: int, end: int) -> Trajectory:
    # every episode before this one has a row more than steps
    after = {name: data[name][first + k : end + k + 1] for name in _AFTER}
    return Trajectory(
        seed=int(data["seed"][k]), episode_id=int(data["episode_id"][k]), **after,
        action=data["action"][first:end], reward=data["reward"][first:end],
        terminated=bool(data["terminated"][k]), end_reason=str(data["end_reason"][k]),
    )  # fmt: skip


def _minari() -> Any:
    try:
        import minari
    except ModuleNotFoundError as error:
        raise HipgError("Minari data sets need Minari: pip install 'hipg-bench[minari]'") from error
    return minari


def _write_minari(name: str, spec: TaskSpec, agent: str, episodes: Sequence[Trajectory]) -> None:
    minari = _minari()
    from gymnasium.spaces import Box
    from minari.data_collector import EpisodeBuffer

    buffer: list[Any] = []
    for k, one in enumerate(episodes):
        steps = len(one.reward)
        last = np.arange(steps) == steps - 1
        one_buffer = EpisodeBuffer(
            id=k, seed=one.seed, options={"episode_id": one.episode_id},
            observations=list(one.observation), actions=list(one.action), rewards=one.reward.tolist(),
            terminations=(last & one.terminated).tolist(),
            truncations=(last & (not one.terminated)).tolist(),
            infos={key: getattr(one, key) for key in ("state", "health", "alive")},
        )  # fmt: skip
        buffer.append(one_buffer)
    first = episodes[0]
    bound = 1.0 if spec.clip_actions else np.inf
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # on authors and links, which a user may add later
        minari.create_dataset_from_buffers(
            name, buffer,
            observation_space=Box(-np.inf, np.inf, first.observation.shape[1:], np.float32),
            action_space=Box(-bound, bound, first.action.shape[1:], np.float64),
            algorithm_name=agent, description=f"{spec.task} v{spec.version}: {spec.summary}",
            requirements=[f"hipg-bench=={metadata.version('hipg-bench')}"],
        )  # fmt: skip
