"""Attention over neighbours: however many an agent sees, in whatever order, each is looked at the same way.

The blocks of an agent's own observation that come one entry per neighbour (or point, or wreck) are cut into
as many tokens; the rest is the agent's own. Tokens of empty slots are left out.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
import pydantic
from jaxtyping import Bool, Float, Int

from hipg_bench.errors import BundleError, hint
from hipg_bench.layout import Layout
from hipg_bench.policies.network_spec import (
    WIDEST,
    NetworkSpec,
    Shapes,
    Tensors,
    check_head,
    check_observation,
    check_shape,
    check_stack,
    forward,
    layers,
    normalise,
    stack_names,
)
from hipg_bench.spec import Params

Name = Annotated[str, pydantic.Field(pattern=r"^[a-z][a-z_]{0,40}$")]
Size = Annotated[int, pydantic.Field(ge=1, le=WIDEST)]
_MOST_BLOCKS = 64
_TAKEN = {"own", "attention", "observation"}
"""Names of other tensors, which no group may have."""


class Group(Params):
    """Blocks that say the same of several neighbours, along their first axis.

    Attributes:
        blocks: their names.
        present: the block, one number per slot, that is above 0 where the slot holds somebody; None: all do.
    """

    blocks: tuple[Name, ...] = pydantic.Field(min_length=1, max_length=_MOST_BLOCKS)
    present: Name | None = None


class AttentionSpec(NetworkSpec):
    """An MLP's, and how an observation falls into tokens.

    Attributes:
        observation: names and shapes of the blocks it was trained on, in order: the task's.
        groups: by name, which is also the name of their embedding's tensors.
        pool: ``attention``: the agent's own embedding asks, as in ``torch.nn.MultiheadAttention``;
            ``mean``: the mean of the embeddings (deep sets).
        heads: of the attention.
    """

    format: ClassVar[str] = "hipg-attention-1"

    observation: tuple[tuple[Name, Annotated[tuple[Size, ...], pydantic.Field(max_length=3)]], ...] = (
        pydantic.Field(max_length=_MOST_BLOCKS)
    )
    groups: dict[Name, Group] = pydantic.Field(min_length=1, max_length=8)
    pool: Literal["attention", "mean"] = "attention"
    heads: int = pydantic.Field(default=1, ge=1, le=64)

    @classmethod
    def of(cls, layout: Layout, *groups: str, **spec: Any) -> AttentionSpec:
        """The spec for a task's observation; ``neighbor`` groups the blocks ``neighbor_...``.

        Args:
            layout: `hipg_bench.make(task).layout.observation`.
            *groups: what the blocks' names begin with.
            **spec: the other fields.

        Raises:
            BundleError: no block's name begins so.
        """
        made: dict[str, Group] = {}
        for group in groups:
            blocks = tuple(block.name for block in layout.present if block.name.startswith(f"{group}_"))
            if not blocks:
                starts = {block.name.partition("_")[0] for block in layout.present}
                raise BundleError(f"no blocks {group + '_...'!r} in the observation{hint(group, starts)}")
            present = next((name for name in blocks if name.endswith(("_seen", "_there"))), None)
            made[group] = Group(blocks=blocks, present=present)
        observation = tuple((block.name, block.shape) for block in layout.present)
        return cls(observation=observation, groups=made, **spec)

    @property
    def observation_size(self) -> int:
        """O."""
        return sum(math.prod(shape) for _, shape in self.observation)

    def columns(self) -> tuple[Int[np.ndarray, "own"], dict[str, Int[np.ndarray, "slots entry"]]]:
        """The observation's columns that are the agent's own, and those of each group's slots.

        Raises:
            BundleError: groups that do not cut the observation into tokens.
        """
        own: dict[str, np.ndarray] = {}
        start = 0
        for name, shape in self.observation:
            own[name] = np.arange(start, start + math.prod(shape)).reshape(shape or (1,))
            start += math.prod(shape)
        slots: dict[str, np.ndarray] = {}
        for name, group in self.groups.items():
            taken = [own.pop(block) for block in group.blocks if block in own]
            if len(taken) < len(group.blocks) or name in _TAKEN:
                raise BundleError(f"group {name!r}: its blocks are not in the observation, or in two groups")
            if len({len(block) for block in taken}) > 1:
                raise BundleError(f"group {name!r}: its blocks have different numbers of slots")
            slots[name] = np.concatenate([block.reshape(len(block), -1) for block in taken], axis=1)
            shape = dict(self.observation).get(group.present or group.blocks[0])
            if group.present and (group.present not in group.blocks or shape != slots[name].shape[:1]):
                raise BundleError(
                    f"group {name!r}: 'present' must be a block of its own with a number per slot"
                )
        if not own:
            raise BundleError("some block must be the agent's own, in no group")
        return np.concatenate([block.ravel() for block in own.values()]), slots

    def present_columns(self) -> dict[str, Int[np.ndarray, "slots"] | None]:
        """Per group, the columns that say which slots hold somebody."""
        starts = np.cumsum([0, *(math.prod(shape) for _, shape in self.observation)]).tolist()
        first = {name: start for (name, _), start in zip(self.observation, starts, strict=False)}
        shapes = dict(self.observation)
        return {
            group: None if one.present is None else first[one.present] + np.arange(shapes[one.present][0])
            for group, one in self.groups.items()
        }


class Attention:
    """A decentralised policy that looks at each neighbour of an agent's own observation alike.

    ``own`` embeds what is the agent's own and ``<group>`` each slot, into D numbers, each followed by the
    activation; ``attention`` (named as in ``torch.nn.MultiheadAttention``) lets the own embedding ask them.
    Own embedding and answer, 2 D numbers, pass the layers ``layer<k>`` to the action. Who sees nobody gets
    zeros for an answer.

    Attributes:
        privileged: it acts on observations.
        spec: what its file declares.
        observation_size, action_size: O and A.
    """

    privileged = False

    def __init__(self, tensors: Tensors, spec: AttentionSpec) -> None:
        """Take float64 tensors, already checked."""
        self.spec, self._tensors = spec, tensors
        self._own, self._slots = spec.columns()
        self._present = spec.present_columns()
        self._layers = layers(tensors, "layer")
        self.observation_size = tensors["observation.mean"].size
        self.action_size = self._layers[-1][1].size // max(spec.bins, 1)

    @staticmethod
    def check(shapes: Shapes, spec: AttentionSpec) -> set[str]:
        """Return the names of the tensors it is made of.

        Raises:
            BundleError: shapes that do not chain, or groups that are not in the observation.
        """
        width = check_observation(shapes)
        if spec.observation_size != width or len(dict(spec.observation)) < len(spec.observation):
            raise BundleError(
                f"the observation's blocks must have different names and hold {width} numbers as "
                f"observation.mean, got {spec.observation_size}"
            )
        own, slots = spec.columns()
        size = (*shapes.get("own.bias", ()), 0)[0]
        if not 0 < size <= WIDEST or size % spec.heads:
            raise BundleError(f"own.bias is ({size},); expected a positive multiple of {spec.heads} heads")
        expected = dict(_embeddings(size, own, slots))
        if spec.pool == "attention":
            expected |= {
                "attention.in_proj_weight": (3 * size, size),
                "attention.in_proj_bias": (3 * size,),
                "attention.out_proj.weight": (size, size),
                "attention.out_proj.bias": (size,),
            }
        for name, shape in expected.items():
            check_shape(shapes, name, shape)
        if "layer0.weight" not in shapes:
            raise BundleError("layer0, from the embeddings to the action, is missing")
        check_head(spec, check_stack(shapes, "layer", 2 * size))
        return {"observation.mean", "observation.scale", *expected} | stack_names(shapes, "layer")

    def initial_state(self, seed: int, episode_id: Int[np.ndarray, "B"], num_agents: int) -> None:
        """Remember nothing."""

    def act(
        self, observation: Float[np.ndarray, "B N O"], memory: None, alive: Bool[np.ndarray, "B N"]
    ) -> tuple[Float[np.ndarray, "B N A"], None]:
        """The best action, without exploration noise; in [-reach, reach]."""
        seen = normalise(self._tensors, observation)
        own = self._embed("own", seen[..., self._own])
        tokens = np.concatenate(
            [self._embed(name, seen[..., at]) for name, at in self._slots.items()], axis=2
        )
        there = np.concatenate([self._there(name, observation) for name in self._slots], axis=2)
        answer = self._ask(own, tokens, there) if self.spec.pool == "attention" else _mean(tokens, there)
        out = forward(self._layers, np.concatenate([own, answer], axis=-1), self.spec)
        return self.spec.action(out), memory

    def _embed(self, name: str, x: Float[np.ndarray, "*lead entry"]) -> Float[np.ndarray, "*lead D"]:
        return self.spec.activate(x @ self._tensors[f"{name}.weight"].T + self._tensors[f"{name}.bias"])

    def _there(self, group: str, observation: Float[np.ndarray, "B N O"]) -> Bool[np.ndarray, "B N slots"]:
        """Which slots hold somebody."""
        columns = self._present[group]
        if columns is None:
            return np.ones((*observation.shape[:2], len(self._slots[group])), bool)
        return observation[..., columns] > 0

    def _ask(
        self,
        own: Float[np.ndarray, "B N D"],
        tokens: Float[np.ndarray, "B N slots D"],
        there: Bool[np.ndarray, "B N slots"],
    ) -> Float[np.ndarray, "B N D"]:
        """The attention's answer to the own embedding."""
        tensors, heads = self._tensors, self.spec.heads
        weights = np.split(tensors["attention.in_proj_weight"], 3)
        biases = np.split(tensors["attention.in_proj_bias"], 3)
        query = (own @ weights[0].T + biases[0]).reshape(*own.shape[:2], heads, -1)
        key, value = (
            (tokens @ weights[k].T + biases[k]).reshape(*tokens.shape[:3], heads, -1) for k in (1, 2)
        )
        fit = np.einsum("bnhd,bnkhd->bnhk", query, key) / math.sqrt(query.shape[-1])
        fit = np.where(there[:, :, None], fit, -np.inf)
        # who sees nobody has no best fit: 0 stands in, and no weight is left
        somebody = there.sum(axis=-1, keepdims=True) > 0
        best = np.where(somebody[..., None], fit.max(-1, keepdims=True), 0.0)
        share = np.exp(fit - best)
        share /= np.maximum(share.sum(-1, keepdims=True), np.finfo(float).tiny)
        mixed = np.einsum("bnhk,bnkhd->bnhd", share, value).reshape(own.shape)
        answer = mixed @ tensors["attention.out_proj.weight"].T + tensors["attention.out_proj.bias"]
        return np.where(somebody, answer, 0.0)


def _embeddings(
    size: int, own: np.ndarray, slots: dict[str, np.ndarray]
) -> Iterator[tuple[str, tuple[int, ...]]]:
    """Names and shapes of what embeds the agent's own and each group's slots."""
    for name, inputs in (("own", own.size), *((group, at.shape[1]) for group, at in slots.items())):
        yield f"{name}.weight", (size, inputs)
        yield f"{name}.bias", (size,)


def _mean(
    tokens: Float[np.ndarray, "B N slots D"], there: Bool[np.ndarray, "B N slots"]
) -> Float[np.ndarray, "B N D"]:
    """Mean over those who are there, 0 if nobody is."""
    total = np.where(there[..., None], tokens, 0.0).sum(axis=2)
    return total / np.maximum(there.sum(axis=2), 1)[..., None]
