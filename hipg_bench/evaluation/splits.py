"""Splits: what a team meets that it was not trained for. None of them changes what is rewarded.

``standard`` is the task itself. ``shift`` changes numbers of the physics and of the hazard; its variants
are dealt to the evaluation seeds in turn. ``forced_death`` kills drawn agents at drawn times. ``ad_hoc``
lets a background policy steer some of the bodies. Rules stand in ``tasks/splits/<split>.toml``, by family;
anchors measured under them in ``tasks/splits/anchors.toml``, by task.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Mapping
from pathlib import Path

import mujoco
import numpy as np
import pydantic
from jaxtyping import Bool, Int

from hipg_bench import registry
from hipg_bench.documents import read_toml
from hipg_bench.env import BatchEnv
from hipg_bench.errors import BundleError, UnknownNameError, hint
from hipg_bench.families import known
from hipg_bench.paths import data_folder
from hipg_bench.policies.network import load_network
from hipg_bench.policies.policy import Policy
from hipg_bench.policies.scripted import Scripted
from hipg_bench.spec import Anchors, Params, TaskSpec, parse

STANDARD = "standard"
SPLITS = (STANDARD, "shift", "forced_death", "ad_hoc")
"""All splits, in the order of tables."""
_BLIND = "scripted_blind"
_DEATH_SCHEDULE, _OTHERS = 0x646F6F6D, 0x6F746872
"""Second words of the Philox keys; neither an environment nor a policy has them."""


class Shift(Params):
    """One variant of a family's physics.

    Attributes:
        params: the family's numbers that differ from the task's.
        friction: factor on the sliding friction of everything.
        strength: factor on the force limits of all actuators.
    """

    params: Mapping[str, float] = pydantic.Field(default={})
    friction: float = pydantic.Field(default=1.0, gt=0, le=4)
    strength: float = pydantic.Field(default=1.0, gt=0, le=4)

    def change(self, scene: mujoco.MjSpec) -> None:
        """Change a composed world's friction and strength."""
        for geom in scene.geoms:
            geom.friction[0] *= self.friction
        for actuator in scene.actuators:
            actuator.forcerange = np.asarray(actuator.forcerange) * self.strength


class SplitConfig(Params):
    """What a split does to the worlds of a family.

    Attributes:
        shifts: variants of the physics; block k of the worlds has variant k modulo their number.
        deaths: share of the team that is killed, at least one agent if above 0.
        window: shares of the horizon between which they are killed.
        others: share of the bodies that the background steers, rounded down.
        background: ``scripted_blind``, or a policy file in ``tasks/splits/``.
    """

    shifts: tuple[Shift, ...] = ()
    deaths: float = pydantic.Field(default=0.0, ge=0, lt=1)
    window: tuple[float, float] = (0.0, 1.0)
    others: float = pydantic.Field(default=0.0, ge=0, lt=1)
    background: str = ""

    def variant(self, block: int) -> int | None:
        """Which of the shifts a block of worlds has."""
        return block % len(self.shifts) if self.shifts else None

    def spec(self, spec: TaskSpec, block: int) -> TaskSpec:
        """The task as it is in a block of worlds, with the anchors it had."""
        variant = self.variant(block)
        if variant is None:
            return spec
        changed = spec.override(**self.shifts[variant].params)
        return changed.model_copy(update={"anchors": spec.anchors})

    def make(self, spec: TaskSpec, block: int, num_envs: int, seed: int, threads: int) -> BatchEnv:
        """Build worlds of a block."""
        variant = self.variant(block)
        if variant is None:
            return registry.make(spec, num_envs, seed, threads=threads)
        changed = registry.definition_of(self.spec(spec, block))
        definition = dataclasses.replace(changed, change_scene=self.shifts[variant].change)
        return BatchEnv(definition, num_envs, seed, threads=threads)

    def death_schedule(self, seed: int, ids: Int[np.ndarray, "B"], spec: TaskSpec) -> Int[np.ndarray, "B N"]:
        """Control step at whose end each agent is killed; -1 for those who are spared."""
        n = spec.num_agents
        schedule = np.full((len(ids), n), -1)
        if self.deaths:
            count = max(1, round(self.deaths * n))
            low, high = (round(share * spec.horizon) for share in self.window)
            for row, chance in zip(schedule, _chances(seed, _DEATH_SCHEDULE, ids), strict=True):
                row[chance.permutation(n)[:count]] = chance.integers(low, high, count, endpoint=True)
        return schedule

    def bodies_of_others(
        self, seed: int, ids: Int[np.ndarray, "B"], num_agents: int
    ) -> Bool[np.ndarray, "B N"]:
        """Who is steered by the background."""
        theirs = np.zeros((len(ids), num_agents), bool)
        count = int(self.others * num_agents)
        if count:
            for row, chance in zip(theirs, _chances(seed, _OTHERS, ids), strict=True):
                row[chance.permutation(num_agents)[:count]] = True
        return theirs

    def background_policy(self, spec: TaskSpec) -> Policy | None:
        """Who steers them; None if the team is whole.

        Raises:
            BundleError: the background is made for other bodies.
        """
        if not self.background:
            return None
        if self.background == _BLIND:
            return Scripted(spec, blind=True)
        network, layout = load_network(folder() / self.background), registry.definition_of(spec).layout
        if (network.observation_size, network.action_size) != (layout.observation.size, layout.action.size):
            raise BundleError(f"{spec.task}: {self.background} is made for other bodies")
        return network


def split_config(split: str, spec: TaskSpec) -> SplitConfig:
    """What a split does to a task.

    Raises:
        UnknownNameError: no such split, or it has no rules for the task's family.
    """
    if split not in SPLITS:
        raise UnknownNameError(f"no split {split!r}{hint(split, SPLITS)}")
    if split == STANDARD:
        return SplitConfig()
    families, lineage = _rules(split), known.lineage(spec.family)
    own = (known.declared(spec.family, "SPLITS") or {}).get(split)
    if own is not None:
        return parse(SplitConfig, own, f"family {spec.family!r}: SPLITS: {split}")
    name = next((name for name in lineage if name in families), None)
    if name is None:
        raise UnknownNameError(f"{spec.task}: {split} has no rules for its family, {spec.family!r}")
    return families[name]


def with_anchors(split: str, spec: TaskSpec) -> TaskSpec:
    """The task with the anchors that were measured in a split, none if none were."""
    if split == STANDARD:
        return spec
    known = registry.tasks().get(spec.task)
    same = known is not None and known.fingerprint == spec.fingerprint
    measured = anchors().get(split, {}).get(spec.task) if same else None
    return spec.model_copy(update={"anchors": measured, "calibration": {}})


@functools.cache
def anchors() -> Mapping[str, Mapping[str, Anchors]]:
    """Split to task to what was measured."""
    path = folder() / "anchors.toml"
    return {
        split: {task: parse(Anchors, values, f"{path}: {split}.{task}") for task, values in tasks.items()}
        for split, tasks in read_toml(path).items()
    }


def folder() -> Path:
    """Where rules, anchors and background policies lie."""
    return data_folder("tasks") / "splits"


@functools.cache
def _rules(split: str) -> Mapping[str, SplitConfig]:
    """Family to what a split does to it."""
    path = folder() / f"{split}.toml"
    return {
        family: parse(SplitConfig, values, f"{path}: {family}") for family, values in read_toml(path).items()
    }


def _chances(seed: int, purpose: int, ids: Int[np.ndarray, "B"]) -> list[np.random.Generator]:
    """A generator per episode, for one purpose."""
    return [
        np.random.Generator(np.random.Philox(key=[seed, purpose], counter=[0, 0, 0, episode]))
        for episode in ids.tolist()
    ]
