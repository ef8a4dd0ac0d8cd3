"""BenchMARL: all tasks as ``HipgTask``, so that its algorithms run on them unchanged.

>>> from hipg_bench.adapters.benchmarl import HipgTask
>>> task = HipgTask.HAZARD_NAV_4.get_task(config={"horizon": 100})

Algorithms without continuous actions (QMIX, VDN, IQL) get the discrete ones of `OneActuator`. BenchMARL's
losses know no mask: to them a dead agent is one that sees zeros and whose actions change nothing. They also
average rewards over the team, so the dead share the team's: else a team would be charged less for each loss.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import torch
import yaml
from benchmarl.environments.common import Task, TaskClass
from tensordict import TensorDictBase
from torchrl.data import Categorical, Composite, TensorSpec
from torchrl.envs import EnvBase, Transform, TransformedEnv

from hipg_bench.adapters.agent_names import numbered
from hipg_bench.adapters.torchrl import HipgEnv
from hipg_bench.errors import SpecError
from hipg_bench.registry import task_spec, tasks

ACTION = ("agents", "action")


class OneActuator(Transform):
    """Discrete actions: rest, or one actuator at one of ``bins`` values from -1 to 1 and all others at 0.

    One choice per agent is all that value decomposition can take, and a grid over all actuators would have
    ``bins`` to the power of A of them; these are 1 + A * bins.
    """

    table: torch.Tensor
    """(1 + A * bins, A) what each choice does."""

    def __init__(self, actuators: int, bins: int) -> None:
        super().__init__(in_keys_inv=[ACTION], out_keys_inv=[ACTION])
        pushes = torch.einsum("ij,b->ibj", torch.eye(actuators), torch.linspace(-1.0, 1.0, bins))
        self.register_buffer("table", torch.cat([torch.zeros(1, actuators), pushes.reshape(-1, actuators)]))

    def transform_action_spec(self, action_spec: TensorSpec) -> TensorSpec:
        """One number per agent instead of A."""
        actions = cast(Composite, action_spec)
        team = actions[ACTION].shape[:-1]
        actions[ACTION] = Categorical(len(self.table), team, device=actions.device)
        return actions

    def _inv_apply_transform(self, state: torch.Tensor) -> torch.Tensor:
        return self.table[state]


class HipgTaskClass(TaskClass):
    """A task for BenchMARL.

    Attributes:
        spec: the task's numbers.
    """

    def __init__(self, name: str, config: dict[str, Any] | None = None) -> None:
        """Check the config.

        Args:
            name: of a task, or of a member of `HipgTask`.
            config: overrides, as for `hipg_bench.make`, and ``bins``, see `OneActuator`.

        Raises:
            UnknownNameError: no such task.
            SpecError: an override that is not allowed, or fewer than two bins.
        """
        super().__init__(name, {"bins": 8, "reward_dead": "team", **(config or {})})
        numbers = {name: value for name, value in self.config.items() if name != "bins"}
        self.spec = task_spec(_TASKS.get(name, name)).override(**numbers)
        if self.config["bins"] < 2:
            raise SpecError(f"{self.spec.task}: bins >= 2 are allowed, got {self.config['bins']}")

    def get_env_fun(
        self, num_envs: int, continuous_actions: bool, seed: int | None, device: torch.device | str
    ) -> Callable[[], EnvBase]:
        """How to make ``num_envs`` worlds as one environment."""

        def env() -> EnvBase:
            worlds = HipgEnv(self.spec, num_envs, seed or 0, device=device)
            if continuous_actions:
                return worlds
            size = worlds.full_action_spec_unbatched[ACTION].shape[-1]
            return TransformedEnv(worlds, OneActuator(size, self.config["bins"]).to(device))

        return env

    def supports_continuous_actions(self) -> bool:
        """Yes."""
        return True

    def supports_discrete_actions(self) -> bool:
        """Yes, see `OneActuator`."""
        return True

    def max_steps(self, env: EnvBase) -> int:
        """The horizon."""
        return self.spec.horizon

    def has_render(self, env: EnvBase) -> bool:
        """No."""
        return False

    def group_map(self, env: EnvBase) -> dict[str, list[str]]:
        """One group, ``"agents"``."""
        return {"agents": list(numbered(self.spec))}

    def observation_spec(self, env: EnvBase) -> Composite:
        """What policies see: neither the joint state nor who is alive."""
        seen = env.full_observation_spec_unbatched.clone()
        del seen["state"], seen["agents", "alive"]
        return seen

    def info_spec(self, env: EnvBase) -> Composite | None:
        """None."""
        return None

    def state_spec(self, env: EnvBase) -> Composite:
        """What central critics and mixers see."""
        return Composite(state=env.full_observation_spec_unbatched["state"].clone())

    def action_spec(self, env: EnvBase) -> Composite:
        """What agents do."""
        return env.full_action_spec_unbatched

    def action_mask_spec(self, env: EnvBase) -> Composite | None:
        """None: the dead may be told anything."""
        return None

    @staticmethod
    def env_name() -> str:
        """Of the folder of the tasks' configs, and in logs."""
        return "hipg"

    @staticmethod
    def log_info(batch: TensorDictBase) -> dict[str, float]:
        """How many of the team were alive, on average over what was collected."""
        return {"collection/alive": batch["next", "agents", "alive"].float().mean().item()}


_TASKS = {name.upper().replace("-", "_"): name for name in tasks()}
"""Enum member to task."""


class _HipgTasks(Task):
    """What the members of `HipgTask` can do."""

    @staticmethod
    def associated_class() -> type[TaskClass]:
        """Of what `get_task` returns."""
        return HipgTaskClass

    def get_task(self, config: dict[str, Any] | None = None) -> TaskClass:
        """The task, by default with the numbers of its file."""
        return HipgTaskClass(self.name, config)

    def get_from_yaml(self, path: str | None = None) -> TaskClass:
        """The task, with a config read from a YAML file, by default with the numbers of its file."""
        return self.get_task(yaml.safe_load(Path(path).read_text("utf-8")) if path else None)


HipgTask = _HipgTasks("HipgTask", dict.fromkeys(_TASKS), module=__name__)
"""All tasks by name: ``hazard_nav-4`` is ``HipgTask.HAZARD_NAV_4``."""
