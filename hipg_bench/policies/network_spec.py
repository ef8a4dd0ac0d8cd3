"""What all declared networks share: normalised observations in, layers, and actions on a grid out.

Inference is NumPy in float64 with outputs (and what is remembered) rounded to 2^-16: a matrix product's last
bits depend on the batch size, and results must not. Widths, depths and weights are bounded, so that no
network overflows or needs more memory than a task's batch may take.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import ClassVar, Literal

import numpy as np
import pydantic
from jaxtyping import Float

from hipg_bench.errors import BundleError
from hipg_bench.spec import Params

CLIP = 10.0
"""Normalised observations are cut to this many standard deviations."""
WIDEST, DEEPEST = 4096, 16
"""Numbers that a layer may put out, and layers of one stack."""
_GRID = 2.0**16

Shapes = Mapping[str, tuple[int, ...]]
"""Tensor name to shape, as a file's header declares them."""
Tensors = Mapping[str, np.ndarray]
"""Tensor name to float64 values."""
Stack = list[tuple[np.ndarray, np.ndarray]]
"""Weights (in, out) and biases of one layer after another."""


class NetworkSpec(Params):
    """What a policy file declares beside its weights; by itself it is an MLP's.

    Attributes:
        activation: of the hidden layers.
        head: how the last layer's outputs become the action: ``mean``, clipped to [-1, 1]; ``linear``, as
            they are, for tasks that do not clip actions (the paper's particles); ``tanh``, squashed into
            [-1, 1]; ``bins``, values of evenly spaced choices, of which the best is taken.
        bins: choices per action coordinate, -1 the first and 1 the last; 0 with other heads.
        reach: full action, which bounded outputs are multiplied by; above 1 only where a task does not clip.
    """

    format: ClassVar[str] = "hipg-mlp-2"

    activation: Literal["tanh", "relu"] = "tanh"
    head: Literal["mean", "linear", "tanh", "bins"] = "mean"
    bins: int = pydantic.Field(default=0, ge=0, le=256)
    reach: float = pydantic.Field(default=1.0, gt=0, le=10)

    def activate(self, x: Float[np.ndarray, "*any"]) -> Float[np.ndarray, "*any"]:
        """The hidden layers' activation."""
        return np.tanh(x) if self.activation == "tanh" else np.maximum(x, 0.0)

    def action(self, out: Float[np.ndarray, "B N out"]) -> Float[np.ndarray, "B N A"]:
        """The last layer's outputs as actions, in [-reach, reach] unless the head is ``linear``."""
        if self.head == "bins":
            values = out.reshape(*out.shape[:-1], -1, self.bins)
            best = quantize(values).argmax(-1)  # rounded: equal values stay equal, the first wins
            chosen = 2.0 * best / (self.bins - 1) - 1.0
        elif self.head == "linear":
            chosen = out
        else:
            chosen = np.tanh(out) if self.head == "tanh" else np.clip(out, -1.0, 1.0)
        return quantize(chosen * self.reach)


def quantize(x: Float[np.ndarray, "*any"]) -> Float[np.ndarray, "*any"]:
    """Rounded to multiples of 2^-16."""
    return np.round(x * _GRID) / _GRID


def normalise(tensors: Tensors, observation: Float[np.ndarray, "B N O"]) -> Float[np.ndarray, "B N O"]:
    """Observations in standard deviations from their mean, cut to `CLIP`."""
    centred = (observation - tensors["observation.mean"]) / tensors["observation.scale"]
    return np.clip(centred, -CLIP, CLIP)


def layers(tensors: Tensors, name: str) -> Stack:
    """The stack ``<name>0``, ``<name>1``, ... of a file."""
    return [
        (tensors[f"{name}{k}.weight"].mT, tensors[f"{name}{k}.bias"]) for k in range(_depth(tensors, name))
    ]


def forward(
    stack: Stack, hidden: Float[np.ndarray, "X Y in"], spec: NetworkSpec
) -> Float[np.ndarray, "X Y out"]:
    """Apply a stack, with activations between its layers and none after the last."""
    for weight, bias in stack[:-1]:
        hidden = spec.activate(hidden @ weight + bias)
    weight, bias = stack[-1]
    return hidden @ weight + bias


def check_observation(shapes: Shapes) -> int:
    """Return O.

    Raises:
        BundleError: mean and scale are not (O,) each.
    """
    width = shapes.get("observation.mean", ())
    if len(width) != 1 or shapes.get("observation.scale") != width or not 0 < width[0] <= WIDEST:
        raise BundleError(f"observation.mean and .scale must be (O,), O <= {WIDEST}, got {width}")
    return width[0]


def check_stack(shapes: Shapes, name: str, width: int, lead: tuple[int, ...] = ()) -> int:
    """Return how many numbers a stack puts out that takes in ``width``; as many if it has no layer.

    Args:
        shapes: of all tensors.
        name: of the stack.
        width: what it takes in.
        lead: (N,) where every agent has weights of its own.

    Raises:
        BundleError: shapes that do not chain, or too many or too wide layers.
    """
    depth = _depth(shapes, name)
    if depth > DEEPEST:
        raise BundleError(f"at most {DEEPEST} layers {name!r} are allowed, got {depth}")
    for k in range(depth):
        weight, bias = shapes.get(f"{name}{k}.weight"), shapes.get(f"{name}{k}.bias", ())
        out = bias[-1] if bias else 0
        if weight != (*lead, out, width) or bias != (*lead, out) or not 0 < out <= WIDEST:
            own = "".join(f"{n}, " for n in lead)
            allowed = f"({own}out, {width}), ({own}out,) with out <= {WIDEST}"
            raise BundleError(f"{name}{k} is {weight}, {bias}; expected {allowed}")
        width = out
    return width


def check_head(spec: NetworkSpec, outputs: int) -> None:
    """Refuse outputs that are no actions."""
    if (spec.head == "bins") != (spec.bins >= 2):
        raise BundleError(f"2 or more bins belong to the head 'bins', got {spec.bins}, {spec.head!r}")
    if spec.bins and outputs % spec.bins:
        raise BundleError(f"{outputs} outputs are not a multiple of {spec.bins} bins")


def check_shape(shapes: Shapes, name: str, expected: tuple[int, ...]) -> None:
    """Refuse a tensor of another shape, or larger than any may be."""
    if shapes.get(name) != expected or math.prod(expected) > WIDEST * WIDEST:
        raise BundleError(f"{name} is {shapes.get(name)}; expected {expected}")


def stack_names(shapes: Shapes, name: str) -> set[str]:
    """The tensors of a stack."""
    return {f"{name}{k}.{part}" for k in range(_depth(shapes, name)) for part in ("weight", "bias")}


def _depth(named: Mapping[str, object], name: str) -> int:
    depth = 0
    while f"{name}{depth}.weight" in named:
        depth += 1
    return depth
