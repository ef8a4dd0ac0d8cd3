"""Policy files of declared networks: data, never code.

The file is safetensors; its metadata declare the network's spec and its header the tensors' shapes, which are
checked before anything is read. What may be declared is in a file per kind: `mlp`, `gru`, `attention`.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import safetensors
from safetensors.numpy import save_file

from hipg_bench.errors import BundleError, SpecError
from hipg_bench.paths import replacing
from hipg_bench.policies.attention import Attention, AttentionSpec
from hipg_bench.policies.gru import GRU, GRUSpec
from hipg_bench.policies.mlp import MLP
from hipg_bench.policies.network_spec import CLIP, NetworkSpec
from hipg_bench.spec import parse

__all__ = ["CLIP", "AttentionSpec", "GRUSpec", "Network", "NetworkSpec", "load_network", "save_network"]

Network = MLP | GRU | Attention

_SPECS: tuple[type[NetworkSpec], ...] = (NetworkSpec, GRUSpec, AttentionSpec)
_FORMATS: Mapping[str, type[NetworkSpec]] = {spec.format: spec for spec in _SPECS}
"""How the metadata's ``format`` begins; the spec follows as JSON.

One entry holds both: several would be written in an order that changes from file to file.
"""
_FIRST_FORMAT = "hipg-mlp-1"
"""An MLP whose spec has all its defaults and is not written."""
_MOST_WEIGHTS = 20_000_000
_MOST_BYTES = 4 * _MOST_WEIGHTS + 1_000_000
_LARGEST = 1e6
"""Weights are at most this: with `network_spec.WIDEST` and `network_spec.DEEPEST`, nothing overflows."""
_MLP = NetworkSpec()


def save_network(tensors: Mapping[str, np.ndarray], path: Path, spec: NetworkSpec = _MLP) -> None:
    """Write a policy file, whole or not at all.

    Args:
        tensors: ``observation.mean``, ``observation.scale`` (O,), and for an MLP ``layer<k>.weight``
            (out, in), ``layer<k>.bias`` (out,) from the first layer to the action, or (N, out, in), (N, out)
            where every agent has weights of its own. For the other kinds see `gru.GRU` and
            `attention.Attention`.
        path: where.
        spec: the network's; its type says which kind it is.

    Raises:
        BundleError: weights that are not finite, or larger than a policy file may hold.
    """
    for name, tensor in tensors.items():
        if not (np.abs(tensor) <= _LARGEST).all():
            raise BundleError(f"{path}: {name} must be finite and within +-{_LARGEST:g}: {_worst(tensor)}")
    plain = {name: np.ascontiguousarray(tensor, np.float32) for name, tensor in tensors.items()}
    with replacing(path) as temporary:
        save_file(plain, temporary, {"format": f"{spec.format} {spec.model_dump_json()}"})


def load_network(path: Path) -> Network:
    """Read a policy file, trusting nothing in it.

    Raises:
        BundleError: not a policy file, an unknown spec, wrong shapes, too large, or weights that are not
            finite.
    """
    try:
        spec, tensors = _read(path)
    except (BundleError, SpecError, safetensors.SafetensorError, OSError) as error:
        raise BundleError(f"{path}: {error}") from error
    if isinstance(spec, AttentionSpec):
        return Attention(tensors, spec)
    return GRU(tensors, spec) if isinstance(spec, GRUSpec) else MLP(tensors, spec)


def network_digest(path: Path) -> str:
    """A hash of a network's tensors and spec: that of a copy with other metadata is the same.

    Raises:
        BundleError: as `load_network`.
    """
    load_network(path)
    spec, tensors = _read(path)
    seen = hashlib.sha256(f"{spec.format} {spec.model_dump_json()}".encode())
    for name in sorted(tensors):
        seen.update(f"{name} {tensors[name].shape}".encode())
        seen.update(tensors[name].tobytes())
    return seen.hexdigest()


def _read(path: Path) -> tuple[NetworkSpec, dict[str, np.ndarray]]:
    """The spec and the tensors, checked."""
    if path.stat().st_size > _MOST_BYTES:
        raise BundleError(f"at most {_MOST_BYTES} bytes are allowed, got {path.stat().st_size}")
    with safetensors.safe_open(path, framework="numpy") as file:
        spec = _declared_spec((file.metadata() or {}).get("format", ""))
        slices = {name: file.get_slice(name) for name in sorted(file.keys())}
        shapes = {name: tuple(one.get_shape()) for name, one in slices.items()}
        kinds = {name: one.get_dtype() for name, one in slices.items()}
        _check_header(spec, shapes, kinds)
        tensors = {name: file.get_tensor(name) for name in shapes}
    for name, tensor in tensors.items():
        if not (np.abs(tensor) <= _LARGEST).all():
            raise BundleError(f"{name} must be finite and within +-{_LARGEST:g}: {_worst(tensor)}")
    if (tensors["observation.scale"] <= 0).any():
        raise BundleError("observation.scale must be > 0")
    return spec, {name: tensor.astype(np.float64) for name, tensor in tensors.items()}


def _declared_spec(declared: str) -> NetworkSpec:
    """Read the metadata's ``format``."""
    name, _, text = declared.partition(" ")
    if name == _FIRST_FORMAT:
        return _MLP
    if name not in _FORMATS:
        allowed = ", ".join(repr(known) for known in (_FIRST_FORMAT, *_FORMATS))
        raise BundleError(f"formats {allowed} are allowed, got {name[:40]!r}")
    try:
        return parse(_FORMATS[name], json.loads(text), "its spec")
    except (SpecError, TypeError, ValueError, RecursionError) as error:
        raise BundleError(f"its spec {text[:200]!r} is refused: {error}") from error


def _check_header(spec: NetworkSpec, shapes: Mapping[str, tuple[int, ...]], kinds: Mapping[str, str]) -> None:
    """Refuse tensors that are not the spec's network."""
    if sum(math.prod(shape) for shape in shapes.values()) > _MOST_WEIGHTS:
        raise BundleError(f"at most {_MOST_WEIGHTS} weights are allowed")
    if isinstance(spec, AttentionSpec):
        names = Attention.check(shapes, spec)
    else:
        names = GRU.check(shapes, spec) if isinstance(spec, GRUSpec) else MLP.check(shapes, spec)
    if names != set(shapes):
        raise BundleError(f"tensors {sorted(names)} are allowed, got {sorted(shapes)[:40]}")
    for name, kind in kinds.items():
        if kind != "F32":
            raise BundleError(f"{name} must be finite float32, got {kind}")


def _worst(tensor: np.ndarray) -> str:
    """What is wrong with a tensor's values."""
    strange = int(np.count_nonzero(~np.isfinite(tensor)))
    return f"{strange} are not finite" if strange else f"the largest is {np.abs(tensor).max():g}"
