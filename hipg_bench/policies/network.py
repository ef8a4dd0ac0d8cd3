"""Policies that are a declared network and its weights: data, never code.

The file is safetensors; its metadata declare the shapes, which are checked before anything is used.
Inference is NumPy in float64 with actions rounded to 2^-16: a matrix product's last bits depend on
the batch size, and results must not.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import safetensors
from jaxtyping import Bool, Float, Int
from safetensors.numpy import save_file

from hipg_bench.errors import BundleError
from hipg_bench.paths import replacing

FORMAT = "hipg-mlp-1"
"""What the metadata's ``format`` says: a tanh MLP over normalised observations."""
CLIP = 10.0
"""Normalised observations are cut to this many standard deviations."""
_GRID = 2.0**16
_MOST_WEIGHTS = 20_000_000


class MLP:
    """A shared decentralised policy: each agent's action from its own observation alone.

    Attributes:
        privileged: it acts on observations.
        observation_size, action_size: O and A.
    """

    privileged = False

    def __init__(self, tensors: Mapping[str, np.ndarray]) -> None:
        """Take the tensors of `save_network`, already checked."""
        depth = sum(name.endswith(".weight") for name in tensors)
        wide = {name: tensor.astype(np.float64) for name, tensor in tensors.items()}
        self._mean, self._scale = wide["observation.mean"], wide["observation.scale"]
        self._layers = [(wide[f"layer{k}.weight"].T, wide[f"layer{k}.bias"]) for k in range(depth)]
        self.observation_size = self._mean.size
        self.action_size = self._layers[-1][1].size

    def initial_state(self, seed: int, episode_id: Int[np.ndarray, "B"], num_agents: int) -> None:
        """Remember nothing."""

    def act(
        self, observation: Float[np.ndarray, "B N O"], memory: None, alive: Bool[np.ndarray, "B N"]
    ) -> tuple[Float[np.ndarray, "B N A"], None]:
        """The mean action, without exploration noise."""
        hidden = np.clip((observation - self._mean) / self._scale, -CLIP, CLIP)
        for weight, bias in self._layers[:-1]:
            hidden = np.tanh(hidden @ weight + bias)
        weight, bias = self._layers[-1]
        return np.round(np.clip(hidden @ weight + bias, -1.0, 1.0) * _GRID) / _GRID, memory


def save_network(tensors: Mapping[str, np.ndarray], path: Path) -> None:
    """Write a policy file, whole or not at all.

    Args:
        tensors: ``observation.mean``, ``observation.scale`` (O,), and ``layer<k>.weight`` (out, in),
            ``layer<k>.bias`` (out,) from the first layer to the action.
        path: where.
    """
    plain = {name: np.ascontiguousarray(tensor, np.float32) for name, tensor in tensors.items()}
    with replacing(path) as temporary:
        save_file(plain, temporary, {"format": FORMAT})


def load_network(path: Path) -> MLP:
    """Read a policy file, trusting nothing in it.

    Raises:
        BundleError: not a policy file, wrong shapes, too large, or weights that are not finite.
    """
    try:
        with safetensors.safe_open(path, framework="numpy") as file:
            declared = (file.metadata() or {}).get("format")
            if declared != FORMAT:
                raise BundleError(f"{path}: format {FORMAT!r} is allowed, got {declared!r}")
            names = sorted(file.keys())
            shapes = {name: tuple(file.get_slice(name).get_shape()) for name in names}
            _check_shapes(path, shapes)
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
    return MLP(tensors)


def _check_shapes(path: Path, shapes: Mapping[str, tuple[int, ...]]) -> None:
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
    for k in range(depth):
        weight, bias = shapes[f"layer{k}.weight"], shapes[f"layer{k}.bias"]
        if len(weight) != 2 or weight[1:] != width or bias != weight[:1]:
            raise BundleError(f"{path}: layer{k} is {weight}, {bias}; expected (out, {width[0]}), (out,)")
        width = bias
