"""TorchRL: B worlds of a task as one native ``EnvBase``, stepped together.

>>> from hipg_bench.adapters.torchrl import HipgEnv
>>> env = HipgEnv("hazard_nav-4", num_envs=64, seed=0)
>>> env.rollout(100, break_when_any_done=False)["next", "agents", "reward"].shape
torch.Size([64, 100, 4, 1])
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Bounded, Categorical, Composite, Unbounded
from torchrl.envs import EnvBase

from hipg_bench.adapters import death
from hipg_bench.adapters.agent_names import numbered
from hipg_bench.arguments import MOST_SEED, whole
from hipg_bench.env import Step
from hipg_bench.errors import HipgError
from hipg_bench.registry import make
from hipg_bench.spec import TaskSpec


class HipgEnv(EnvBase):
    """B worlds of a task; the team is the group ``"agents"``, which keeps its size when agents die (`death`).

    A tensordict (B,) holds ``("agents", "observation")`` (B, N, O), ``("agents", "action")`` (B, N, A) within
    [-1, 1], ``("agents", "reward")`` (B, N, 1), ``("agents", "alive")`` (B, N, 1), the mask that losses need,
    ``"state"`` (B, S) for central critics, and ``"done"``, ``"terminated"``, ``"truncated"`` (B, 1).

    Attributes:
        spec: the task's numbers.
        group_map: ``"agents"`` to the agents' names.
    """

    def __init__(
        self,
        task: str | TaskSpec,
        num_envs: int = 1,
        seed: int | None = None,
        *,
        device: torch.device | str = "cpu",
        threads: int = 0,
        **overrides: Any,
    ) -> None:
        """Build the worlds: device is where tensors are put, the rest is as for `hipg_bench.make`.

        Without a seed the first episodes are others each time; `set_seed` replaces it.
        """
        super().__init__(device=torch.device(device), batch_size=torch.Size((num_envs,)))
        env = self._env = make(task, num_envs, seed, threads=threads, autoreset=False, **overrides)
        self.spec = env.spec
        self.group_map = {"agents": list(numbered(env.spec))}
        self._every, self._new_seed = np.ones(num_envs, bool), None
        self._alive = np.zeros((num_envs, env.num_agents), bool)
        self._ends = np.ones((2, num_envs), bool)
        size, team = torch.Size, torch.Size((env.num_agents,))
        flag = Categorical(2, size((1,)), dtype=torch.bool)
        sees = Composite(
            observation=Unbounded(size((*team, env.observation_size)), dtype=torch.float32),
            alive=Categorical(2, size((*team, 1)), dtype=torch.bool),
            shape=team,
        )
        does = Composite(
            action=Bounded(-1.0, 1.0, size((*team, env.action_size)), dtype=torch.float32), shape=team
        )
        paid = Composite(reward=Unbounded(size((*team, 1)), dtype=torch.float32), shape=team)
        self.observation_spec = self._all(
            agents=sees, state=Unbounded(size((env.state_size,)), dtype=torch.float32)
        )
        self.action_spec, self.reward_spec = self._all(agents=does), self._all(agents=paid)
        self.done_spec = self._all(done=flag, terminated=flag.clone(), truncated=flag.clone())

    def _reset(self, tensordict: TensorDictBase | None, **kwargs: Any) -> TensorDict:
        """Start the worlds that ``"_reset"`` names, by default all."""
        worlds = np.flatnonzero(self._named(tensordict, "_reset"))
        step = self._env.reset(worlds=worlds, seed=self._new_seed)
        self._new_seed = None
        self._ends[:, worlds] = False
        return self._tensors(step)

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        """Advance the worlds that ``"_step"`` names, by default all."""
        env, moving = self._env, self._named(tensordict, "_step")
        over = self._ends.any(axis=0) & moving
        if over.any():
            raise HipgError(f"{self.spec.task}: env {over.argmax()} is over or new: it waits for reset()")
        # who is to stand still takes part in the step, and is then put back
        still = np.flatnonzero(~moving)
        rows = env.rows[still] if len(still) else None
        if rows is not None:
            env.load_rows(still, rows)
        step = env.step(tensordict.get(("agents", "action")).numpy(force=True))
        reward, ends = death.pay(self.spec, step, self._alive), np.stack(death.ends(self.spec, step))
        if rows is not None:
            step = env.load_rows(still, rows)
            reward[still], ends[:, still] = 0.0, self._ends[:, still]
        self._ends = ends
        return self._tensors(step, reward=reward[..., None].astype(np.float32))

    def _named(self, tensordict: TensorDictBase | None, mask: str) -> Bool[np.ndarray, "B"]:
        named = None if tensordict is None else tensordict.get(mask, None)
        return self._every if named is None else named.numpy(force=True).reshape(self._every.shape)

    def _all(self, **of_one_world: Any) -> Composite:
        return Composite(of_one_world).expand(self.batch_size).to(self.device)

    def _tensors(self, step: Step, **paid: Float[np.ndarray, "B N 1"]) -> TensorDict:
        """What is seen now, and what is over; a step's arrays are the caller's, so none is copied."""
        self._alive, ends = step.info["final_alive"], torch.from_numpy(self._ends[:, :, None].copy())
        agents = {"observation": step.observation, "alive": step.info["alive"][..., None], **paid}
        tensors = {name: torch.from_numpy(array) for name, array in agents.items()}
        shown = {
            "agents": TensorDict(tensors, self._alive.shape, self.device),
            "state": torch.from_numpy(step.info["state"]),
            "done": ends.any(0),
            "terminated": ends[0],
            "truncated": ends[1],
        }
        return TensorDict(shown, self.batch_size, self.device)

    def set_seed(self, seed: Any = None, static_seed: bool = False) -> int | None:
        """See TorchRL's.

        Raises:
            SpecError: not a whole number in 0..2^64 - 1.
        """
        if seed is not None:
            seed = whole(seed, f"{self.spec.task}: seed", 0, MOST_SEED)
        return super().set_seed(seed, static_seed)

    def _set_seed(self, seed: int | None) -> None:
        """From the next reset on, worlds are those of this seed."""
        self._new_seed = seed

    def close(self, *, raise_if_closed: bool = True) -> None:
        """Refuse further use."""
        self._env.close()
        super().close(raise_if_closed=raise_if_closed)
