"""Learning from replayed steps: what MADDPG and QMIX share, which is all but what they learn."""

from __future__ import annotations

import abc
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, Shaped
from tensordict import TensorDict
from torch import Tensor
from torchrl.modules import MultiAgentMLP

from hipg_bench.env import BatchEnv, Step
from hipg_bench.errors import HipgError, ResumeError
from hipg_bench.learning import checkpoint
from hipg_bench.learning.networks import RunningNorm
from hipg_bench.learning.settings import ReplaySettings
from hipg_bench.policies.network import NetworkSpec, save_network
from hipg_bench.registry import make

Arrays = dict[str, np.ndarray]


class Replay:
    """The latest steps of B worlds, in files that are mapped into memory.

    Column b holds what world b showed, row by row in the order of time; beside each view stands what
    was done about it and what came of that. So the view that a step led to is the next row's, stored
    once. Where an episode ends, a closing row holds its last view and starts no step.

    The files are a ring of ``window + spare`` rows, of which the latest ``window`` are sampled: up to
    ``spare`` rows written after a checkpoint overwrite nothing that a run going on from there could sample.

    Attributes:
        lost: not all files were there, so there is nothing to go on from.
    """

    def __init__(
        self, folder: Path, num_envs: int, window: int, spare: int, views: Arrays, outcomes: Arrays
    ) -> None:
        """Map the files of a folder, new ones where there are none.

        Args:
            folder: where.
            num_envs: B.
            window: rows of a world that are sampled, the latest.
            spare: rows that may be written between two checkpoints.
            views: name to an example of one world's view.
            outcomes: name to an example of what is done and comes of it.

        Raises:
            HipgError: the disk is too small.
        """
        self.window = window
        self._rows = window + spare + 1
        self._views = tuple(views)
        self._worlds = np.arange(num_envs)
        examples = {**views, **outcomes, "starts": np.zeros((), bool)}
        folder.mkdir(parents=True, exist_ok=True)
        self._check_space(folder, num_envs, examples)
        self.lost = False
        self._arrays = {name: self._mapped(folder / f"{name}.npy", one) for name, one in examples.items()}
        self._place = np.zeros(num_envs, np.int64)  # of each world's latest view
        self._written = np.zeros(num_envs, np.int64)  # rows before it

    def begin(self, view: Arrays) -> None:
        """Write what the worlds show at first."""
        self._show(view, self._worlds)

    def add(self, outcome: Arrays, view: Arrays, done: Bool[np.ndarray, "B"], last: Arrays) -> None:
        """Write a step of all worlds.

        Args:
            outcome: what was done about the latest view, and what came of it.
            view: what the worlds show now: what the step led to, or the next episode's first view.
            done: the step ended the episode.
            last: what it led to where it did, only of those worlds.
        """
        for name, values in outcome.items():
            self._arrays[name][self._place, self._worlds] = values
        self._arrays["starts"][self._place, self._worlds] = True
        self._advance(self._worlds)
        self._show(view, self._worlds)
        over = np.flatnonzero(done)
        if len(over):
            self._show(last, over)
            self._advance(over)
            self._show({name: view[name][over] for name in self._views}, over)

    def sample(self, n: int) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        """Draw n steps evenly, with torch's random numbers: views with outcomes, and views they led to."""
        place, world = self._draw(n)
        after = (place + 1) % self._rows
        now = {name: torch.from_numpy(array[place, world]) for name, array in self._arrays.items()}
        led_to = {name: torch.from_numpy(self._arrays[name][after, world]) for name in self._views}
        return now, led_to

    def state_dict(self) -> dict[str, Tensor]:
        """What a checkpoint holds; the rows are on disk already."""
        return {"place": torch.from_numpy(self._place), "written": torch.from_numpy(self._written)}

    def load_state_dict(self, content: Mapping[str, Tensor]) -> None:
        """Go on from a checkpoint."""
        self._place, self._written = content["place"].numpy().copy(), content["written"].numpy().copy()

    def _draw(self, n: int) -> tuple[Int[np.ndarray, "n"], Int[np.ndarray, "n"]]:
        """Rows and worlds of n steps; closing rows that are hit are drawn again."""
        reach = np.minimum(self._written, self.window)
        places, worlds = np.empty(0, np.int64), np.empty(0, np.int64)
        while len(places) < n:
            world = torch.randint(len(reach), (2 * n,)).numpy()
            age = 1 + (torch.rand(2 * n, dtype=torch.float64).numpy() * reach[world]).astype(np.int64)
            place = (self._place[world] - age) % self._rows
            hit = self._arrays["starts"][place, world]
            places, worlds = np.append(places, place[hit]), np.append(worlds, world[hit])
        return places[:n], worlds[:n]

    def _advance(self, worlds: Int[np.ndarray, "n"]) -> None:
        self._place[worlds] = (self._place[worlds] + 1) % self._rows
        self._written[worlds] += 1

    def _show(self, view: Arrays, worlds: Int[np.ndarray, "n"]) -> None:
        place = self._place[worlds]
        for name in self._views:
            self._arrays[name][place, worlds] = view[name]
        self._arrays["starts"][place, worlds] = False

    def _check_space(self, folder: Path, num_envs: int, examples: Arrays) -> None:
        """A full disk would end the run with a signal, not an error."""
        needed = self._rows * num_envs * sum(one.nbytes for one in examples.values())
        used = sum(path.stat().st_size for path in folder.glob("*.npy"))
        free = shutil.disk_usage(folder).free
        if needed > free + used:
            raise HipgError(
                f"{folder}: a buffer of {self.window * num_envs:,} steps takes {needed / 1e9:.1f} GB, "
                f"{free / 1e9:.1f} are free: choose a smaller one with --set buffer=STEPS"
            )

    def _mapped(self, path: Path, example: np.ndarray) -> Shaped[np.ndarray, "rows B *shape"]:
        shape = (self._rows, len(self._worlds), *example.shape)
        if path.exists():
            mapped = np.lib.format.open_memmap(path, "r+")
            if mapped.shape == shape and mapped.dtype == example.dtype:
                return np.asarray(mapped)
        self.lost = True
        return np.asarray(np.lib.format.open_memmap(path, "w+", example.dtype, shape))


class ReplayTrainer(abc.ABC):
    """Everything that a run which learns from replayed steps carries from one iteration to the next.

    Attributes:
        spec: of the policy's network.
        body: that network, without normalisation and head.
    """

    spec: NetworkSpec
    body: MultiAgentMLP
    choice_type: ClassVar[type[np.generic]] = np.float32
    """Of what is stored for every action coordinate."""

    def __init__(self, settings: ReplaySettings, folder: Path) -> None:
        """Make the worlds; the replay is kept in ``folder``."""
        torch.manual_seed(settings.seed)
        self.settings, self._folder = settings, folder
        self.env: BatchEnv = make(
            settings.task,
            settings.num_envs,
            settings.seed,
            threads=torch.get_num_threads(),
            weights=settings.weights,
        )
        env, plain = self.env, not settings.normalize_inputs
        self.norm = RunningNorm(env.observation_size, np.arange(env.observation_size) if plain else None)
        self.state_norm = RunningNorm(
            env.state_size, np.arange(env.state_size) if plain else env.layout.health_columns
        )
        self.step: Step = env.reset()
        self.iteration = self.updates = 0
        view = _view(self.step)
        self.replay = Replay(
            folder,
            settings.num_envs,
            window=-(-settings.buffer // settings.num_envs),
            spare=2 * settings.rollout,  # an iteration, even if every step ends an episode
            views={name: values[0] for name, values in view.items()},
            outcomes={
                "action": np.zeros((env.num_agents, env.action_size), self.choice_type),
                "reward": np.zeros((), np.float32),
                "terminated": np.zeros((), bool),
            },
        )

    @abc.abstractmethod
    def choose(
        self, observation: Float[Tensor, "B N O"], acting: Float[Tensor, "B N"]
    ) -> Shaped[np.ndarray, "B N A"]:
        """What to store as the worlds' actions, with exploration; observations are normalised."""

    @abc.abstractmethod
    def pushes(self, choice: Shaped[np.ndarray, "B N A"]) -> Float[np.ndarray, "B N A"]:
        """The environment's actions."""

    @abc.abstractmethod
    def improve(self, batch: TensorDict) -> dict[str, float]:
        """One update on a sample of `_sample`. Returns what to log."""

    @abc.abstractmethod
    def learned(self) -> dict[str, Any]:
        """Everything else that a checkpoint holds: what has a ``state_dict``, by name."""

    def start(self) -> None:  # noqa: B027  nothing to do is right
        """A new run needs no preparation."""

    def save_networks(self, path: Path) -> None:  # noqa: B027
        """There is nothing to audit."""

    def finish(self) -> None:
        """Remove the replay: a finished run is not resumed."""
        shutil.rmtree(self._folder, ignore_errors=True)

    def iterate(self) -> dict[str, float]:
        """T steps of every world, and the updates that fall due on the way. Returns what to log."""
        settings, steps = self.settings, self.iteration * self.settings.num_envs * self.settings.rollout
        logs: list[dict[str, float]] = []
        ended: list[Arrays] = []
        if self.iteration == 0:
            self.replay.begin(_view(self.step))
        for _ in range(settings.rollout):
            ended.append(self._play())
            steps += settings.num_envs
            due = max(0, steps - settings.learning_starts) / settings.update_every
            while self.updates < int(due):
                logs.append(self.improve(self._sample()))
                self.updates += 1
        self.iteration += 1
        means = {name: float(np.mean([log[name] for log in logs])) for name in (logs[0] if logs else ())}
        return means | _mean_metrics(ended)

    @torch.no_grad()
    def _play(self) -> Arrays:
        """One step of every world, stored. Returns the metrics of the episodes that ended."""
        was = self.step
        alive = was.info["alive"]
        observation = torch.from_numpy(was.observation)
        self.norm.update(observation[torch.from_numpy(alive)])
        self.state_norm.update(torch.from_numpy(was.info["state"]))
        choice = self.choose(self.norm(observation), self._acting(torch.from_numpy(alive)))
        now = self.step = self.env.step(self.pushes(choice))
        done = now.terminated | now.truncated
        self.replay.add(
            {
                "action": np.where(alive[..., None], choice, 0),
                "reward": now.reward,
                "terminated": now.terminated,
            },
            _view(now),
            done,
            {
                "observation": now.info["final_observation"],
                "state": now.info["final_state"],
                "alive": now.info["final_alive"][done],
            },
        )
        return {name: values[done] for name, values in now.info["metrics"].items()}

    @torch.no_grad()
    def _sample(self) -> TensorDict:
        """A batch of X steps: ``observation`` (X, N, O), ``acting`` (X, N), ``state`` (X, S), ``action``.

        Of what they led to, ``next`` holds the same but ``action`` (X, N, A), and ``reward``, ``done``,
        ``terminated`` (X, 1). Views are normalised. Truncation is no end: ``done`` is ``terminated``.
        """
        now, led_to = self.replay.sample(self.settings.batch)
        ended = now["terminated"][:, None]
        after = {"reward": now["reward"][:, None], "done": ended, "terminated": ended}
        values: dict[str, Any] = {
            **self._shown(now),
            "action": now["action"],
            "next": {**self._shown(led_to), **after},
        }
        return TensorDict(values, [self.settings.batch])

    def _shown(self, view: dict[str, Tensor]) -> dict[str, Tensor]:
        return {
            "observation": self.norm(view["observation"]),
            "state": self.state_norm(view["state"]),
            "acting": self._acting(view["alive"]),
        }

    def _acting(self, alive: Bool[Tensor, "X N"]) -> Float[Tensor, "X N"]:
        """1 for those whose actions count."""
        return alive.float() if self.settings.mask_dead else torch.ones(alive.shape)

    def save_policy(self, path: Path) -> None:
        """Write the policy file."""
        tensors = {"observation.mean": self.norm.offset, "observation.scale": self.norm.scale}
        params: Any = self.body.params
        for k, layer in enumerate(sorted(params.keys(), key=int)):
            for part in ("weight", "bias"):
                tensors[f"layer{k}.{part}"] = params[layer, part]
        save_network({name: tensor.detach().numpy() for name, tensor in tensors.items()}, path, self.spec)

    def save(self, path: Path) -> None:
        """Write a checkpoint, whole or not at all; to be called after every iteration."""
        content = {
            "settings": self.settings.model_dump_json(),
            "iteration": self.iteration,
            "updates": self.updates,
            "parts": {name: part.state_dict() for name, part in self._parts().items()},
            "random": torch.get_rng_state(),
            "worlds": torch.from_numpy(self.env.rows),
        }
        checkpoint.save(path, content)

    def resume(self, path: Path) -> None:
        """Go on from a checkpoint of the same settings, as if never stopped.

        Raises:
            ResumeError: the checkpoint is damaged or of a run with other settings, or there is something
                left to do and the replay is gone.
        """
        content = checkpoint.load(path)
        self.settings.check_resumes(content["settings"], path)
        self.iteration, self.updates = content["iteration"], content["updates"]
        if self.replay.lost and self.iteration < self.settings.iterations:
            raise ResumeError(
                f"{path}: the replay beside it is gone (a finished run's is removed): start again"
            )
        for name, part in self._parts().items():
            part.load_state_dict(content["parts"][name])
        self.step = self.env.load_rows(np.arange(self.env.num_envs), content["worlds"].numpy())
        torch.set_rng_state(content["random"])

    def _parts(self) -> dict[str, Any]:
        return {"norm": self.norm, "state_norm": self.state_norm, "replay": self.replay, **self.learned()}


def _view(step: Step) -> Arrays:
    return {"observation": step.observation, "state": step.info["state"], "alive": step.info["alive"]}


def _mean_metrics(ended: list[Arrays]) -> dict[str, float]:
    """Mean of each metric over the episodes in which it is defined, and how many ended."""
    means: dict[str, float] = {}
    for name in ended[0]:
        values = np.concatenate([one[name] for one in ended])
        if np.isfinite(values).any():
            means[name] = float(np.nanmean(values))
    return means | {"episodes": float(sum(len(one["return"]) for one in ended))}
