"""Policies that are a declared network and its weights: data, never code.

The file is safetensors; its metadata declare the network's form and the tensors their shapes, which are
checked before anything is used. Inference is NumPy in float64 with outputs rounded to 2^-16: a matrix
product's last bits depend on the batch size, and results must not.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Literal

import numpy as np
import pydantic
import safetensors
from jaxtyping import Bool, Float, Int
from safetensors.numpy import save_file

from hipg_bench.errors import BundleError, SpecError
from hipg_bench.paths import replacing
from hipg_bench.spec import Params, parse

FORMAT = "hipg-mlp-2"
"""How the metadata's ``format`` begins: an MLP over normalised observations; its `Form` follows as JSON.

One entry holds both: several would be written in an order that changes from file to file.
"""
_FIRST_FORMAT = "hipg-mlp-1"
"""The same without a `Form`: all its defaults."""
CLIP = 10.0
"""Normalised observations are cut to this many standard deviations."""
_GRID = 2.0**16
_MOST_WEIGHTS = 20_000_000


class Form(Params):
    """What a policy file declares beside its weights.

    Attributes:
        activation: of the hidden layers.
        head: how the last layer's outputs become the action: ``mean``, cut to [-1, 1]; ``tanh``, squashed
            into it; ``bins``, values of evenly spaced choices, of which the best is taken.
        bins: choices per action coordinate, -1 the first and 1 the last; 0 with other heads.
        reach: full action; above 1 only where a task does not clip (the paper's particles).
    """

    activation: Literal["tanh", "relu"] = "tanh"
    head: Literal["mean", "tanh", "bins"] = "mean"
    bins: int = pydantic.Field(default=0, ge=0, le=256)
    reach: float = pydantic.Field(default=1.0, gt=0, le=10)


class MLP:
    """A decentralised policy: each agent's action from its own observation alone.

    Attributes:
        privileged: it acts on observations.
        form: what its file declares.
        observation_size, action_size: O and A.
        num_agents: N where every agent has weights of its own, None where all share theirs.
    """

    privileged = False

    def __init__(self, tensors: Mapping[str, np.ndarray], form: Form) -> None:
        """Take the tensors of `save_network`, already checked."""
        depth = sum(name.endswith(".weight") for name in tensors)
        wide = {name: tensor.astype(np.float64) for name, tensor in tensors.items()}
        self.form = form
        self._mean, self._scale = wide["observation.mean"], wide["observation.scale"]
        self._layers = [(wide[f"layer{k}.weight"].mT, wide[f"layer{k}.bias"]) for k in range(depth)]
        last = self._layers[-1][1]
        self.num_agents = len(last) if last.ndim == 2 else None
        if self.num_agents is not None:
            self._layers = [(weight, bias[:, None]) for weight, bias in self._layers]
        self.observation_size = self._mean.size
        self.action_size = last.shape[-1] // max(form.bins, 1)

    def initial_state(self, seed: int, episode_id: Int[np.ndarray, "B"], num_agents: int) -> None:
        """Remember nothing.

        Raises:
            BundleError: every agent has weights of its own, and they are not this many.
        """
        if self.num_agents not in (None, num_agents):
            raise BundleError(f"the network has weights for {self.num_agents} agents, the task {num_agents}")

    def act(
        self, observation: Float[np.ndarray, "B N O"], memory: None, alive: Bool[np.ndarray, "B N"]
    ) -> tuple[Float[np.ndarray, "B N A"], None]:
        """The best action, without exploration noise; in [-reach, reach]."""
        hidden = np.clip((observation - self._mean) / self._scale, -CLIP, CLIP)
        own = self.num_agents is not None
        out = self._output(hidden.swapaxes(0, 1)).swapaxes(0, 1) if own else self._output(hidden)
        return np.round(self._head(out) * self.form.reach * _GRID) / _GRID, memory

    def _output(self, hidden: Float[np.ndarray, "X Y O"]) -> Float[np.ndarray, "X Y out"]:
        """The last layer's; X are the agents where each has weights of its own."""
        for weight, bias in self._layers[:-1]:
            hidden = hidden @ weight + bias
            hidden = np.tanh(hidden) if self.form.activation == "tanh" else np.maximum(hidden, 0.0)
        weight, bias = self._layers[-1]
        return hidden @ weight + bias

    def _head(self, out: Float[np.ndarray, "B N out"]) -> Float[np.ndarray, "B N A"]:
        """Actions in [-1, 1]."""
        if self.form.head == "bins":
            values = out.reshape(*out.shape[:-1], self.action_size, self.form.bins)
            best = np.round(values * _GRID).argmax(-1)  # rounded: equal values stay equal, the first wins
            return 2.0 * best / (self.form.bins - 1) - 1.0
        return np.tanh(out) if self.form.head == "tanh" else np.clip(out, -1.0, 1.0)


_SHARED = Form()


def save_network(tensors: Mapping[str, np.ndarray], path: Path, form: Form = _SHARED) -> None:
    """Write a policy file, whole or not at all.

    Args:
        tensors: ``observation.mean``, ``observation.scale`` (O,), and ``layer<k>.weight`` (out, in),
            ``layer<k>.bias`` (out,) from the first layer to the action, or (N, out, in), (N, out) where
            every agent has weights of its own.
        path: where.
        form: the network's.
    """
    plain = {name: np.ascontiguousarray(tensor, np.float32) for name, tensor in tensors.items()}
    with replacing(path) as temporary:
        save_file(plain, temporary, {"format": f"{FORMAT} {form.model_dump_json()}"})


def load_network(path: Path) -> MLP:
    """Read a policy file, trusting nothing in it.

    Raises:
        BundleError: not a policy file, an unknown form, wrong shapes, too large, or weights that are not
            finite.
    """
    try:
        with safetensors.safe_open(path, framework="numpy") as file:
            form = _declared_form(path, (file.metadata() or {}).get("format", ""))
            names = sorted(file.keys())
            shapes = {name: tuple(file.get_slice(name).get_shape()) for name in names}
            _check_shapes(path, shapes, form)
            tensors = {name: file.get_tensor(name) for name in names}
    except (safetensors.SafetensorError, OSError) as error:
        raise BundleError(f"{path}: cannot be read: {error}") from error
    for name, tensor in tensors.items():
        if tensor.dtype != np.float32 or not np.isfinite(tensor).all():
            raise BundleError(
                f"{path}: {name} must be finite float32, got {tensor.dtype} or values that are not"
            )
    if (tensors["observation.scale"] <= 0).any():
        raise BundleError(f"{path}: observation.scale must be > 0")
    return MLP(tensors, form)


def _declared_form(path: Path, declared: str) -> Form:
    """Read the metadata's ``format``."""
    name, _, text = declared.partition(" ")
    if name not in (FORMAT, _FIRST_FORMAT):
        raise BundleError(f"{path}: formats {_FIRST_FORMAT!r} and {FORMAT!r} are allowed, got {name!r}")
    try:
        form = parse(Form, json.loads(text) if name == FORMAT else {}, str(path))
    except (SpecError, TypeError, RecursionError, json.JSONDecodeError) as error:
        raise BundleError(f"{path}: its form {text!r} is refused: {error}") from error
    if (form.head == "bins") != (form.bins >= 2):
        raise BundleError(f"{path}: 2 or more bins belong to the head 'bins', got {form.bins}, {form.head!r}")
    return form


def _check_shapes(path: Path, shapes: Mapping[str, tuple[int, ...]], form: Form) -> None:
    """Refuse shapes that do not chain from the observation to the action."""
    depth = sum(name.endswith(".weight") for name in shapes)
    expected = {"observation.mean", "observation.scale"}
    expected |= {f"layer{k}.{part}" for k in range(depth) for part in ("weight", "bias")}
    if depth == 0 or set(shapes) != expected:
        raise BundleError(f"{path}: tensors {sorted(expected)} are allowed, got {sorted(shapes)}")
    if sum(int(np.prod(shape)) for shape in shapes.values()) > _MOST_WEIGHTS:
        raise BundleError(f"{path}: at most {_MOST_WEIGHTS} weights are allowed")
    width = shapes["observation.mean"]
    if len(width) != 1 or shapes["observation.scale"] != width:
        raise BundleError(f"{path}: observation.mean and .scale must be (O,), got {width}")
    agents = shapes["layer0.bias"][:-1]  # (N,) where every agent has weights of its own, or ()
    for k in range(depth):
        weight, bias = shapes[f"layer{k}.weight"], shapes[f"layer{k}.bias"]
        if len(agents) > 1 or weight != (*bias, *width) or bias[:-1] != agents or 0 in bias or not bias:
            own = "".join(f"{n}, " for n in agents[:1])
            allowed = f"({own}out, {width[0]}), ({own}out,)"
            raise BundleError(f"{path}: layer{k} is {weight}, {bias}; expected {allowed}")
        width = bias[-1:]
    if form.bins and width[0] % form.bins:
        raise BundleError(f"{path}: {width[0]} outputs are not a multiple of {form.bins} bins")
