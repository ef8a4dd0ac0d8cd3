"""ONNX graphs of others, looked at before they are run: what they may consist of.

The file is parsed here as plain data; `onnx.checker` and ONNX Runtime see it in the sandboxed child only
(``sandbox/inside/onnx_runner.py``). There it is asked for one agent of one world at a time, so no graph can
let agents know more than they see, nor can actions depend on the batch.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from hipg_bench.errors import BundleError, hint

MOST_BYTES = 64_000_000
"""Of a graph with its weights."""
OPSETS = range(13, 24)
"""Versions of the operators that may be used."""
_DOMAINS = ("", "ai.onnx")
_CHANCE = frozenset(
    {"RandomNormal", "RandomNormalLike", "RandomUniform", "RandomUniformLike", "Multinomial", "Bernoulli"}
)
"""Operators that would make a result depend on more than what is seen."""
_EXTERNAL, _FLOAT = 1, 1  # TensorProto.EXTERNAL, TensorProto.FLOAT
_WIDEST = 65_536
_MOST_NODES = 20_000

Dims = tuple[int, ...]
"""A shape; -1 for a size with a name."""


def check_graph(path: Path, observation_size: int, action_size: int) -> None:
    """Refuse a file that is not a graph from ``observation`` (1, O) to ``action`` (1, A).

    It may also have ``memory_in`` and ``memory_out``, of one shape, which is what an agent remembers (zeros
    at the start). All are float32; the first axis is 1 or has a name.

    Raises:
        BundleError: it is not, or it holds what may not be run; or the package ``onnx`` is missing.
    """
    size = path.stat().st_size
    if size > MOST_BYTES:
        raise BundleError(f"{path}: at most {MOST_BYTES} bytes are allowed, got {size}")
    try:
        model = _parsed(path)
        _check_model(model)
        _check_interface(model.graph, observation_size, action_size)
    except BundleError as error:
        raise BundleError(f"{path}: {error}") from error


def _parsed(path: Path) -> Any:
    """The file's ModelProto."""
    try:
        import onnx
        from google.protobuf.message import DecodeError
    except ImportError as error:
        raise BundleError("ONNX agents need: pip install 'hipg-bench[onnx]'") from error
    model = onnx.ModelProto()
    try:
        model.ParseFromString(path.read_bytes())
    except DecodeError as error:
        raise BundleError("not an ONNX file") from error
    return model


def _check_model(model: Any) -> None:
    """Refuse what may not be run."""
    versions = {entry.domain: entry.version for entry in model.opset_import}
    for domain, version in versions.items():
        if domain not in _DOMAINS:
            raise BundleError(f"operators of the domain {domain!r} are not allowed, only ONNX's own")
        if version not in OPSETS:
            raise BundleError(f"opset {OPSETS[0]} to {OPSETS[-1]} is allowed, got {version}: export again")
    if not versions or len(versions) < len(model.opset_import):
        raise BundleError("it must name one opset")
    if model.functions or model.training_info:
        raise BundleError("functions and training steps of its own are not allowed: export it inlined")
    nodes = 0
    for graph in _graphs(model.graph):
        if graph.sparse_initializer:
            raise BundleError("sparse weights are not allowed")
        nodes += len(graph.node)
        for tensor in graph.initializer:
            _check_tensor(tensor)
        for node in graph.node:
            _check_node(node)
    if not 0 < nodes <= _MOST_NODES:
        raise BundleError(f"1 to {_MOST_NODES} operators are allowed, got {nodes}")


def _graphs(graph: Any) -> Iterator[Any]:
    """A graph and those in the branches and loops of its nodes."""
    yield graph
    for node in graph.node:
        for attribute in node.attribute:
            for inner in (*([attribute.g] if attribute.HasField("g") else []), *attribute.graphs):
                yield from _graphs(inner)


def _check_node(node: Any) -> None:
    if node.domain not in _DOMAINS:
        raise BundleError(f"operator {node.op_type!r} of the domain {node.domain!r} is not allowed")
    if node.op_type in _CHANCE:
        raise BundleError(f"operator {node.op_type!r} is not allowed: actions must not be drawn at random")
    for attribute in node.attribute:
        if attribute.HasField("sparse_tensor") or attribute.sparse_tensors:
            raise BundleError("sparse weights are not allowed")
        for tensor in (*([attribute.t] if attribute.HasField("t") else []), *attribute.tensors):
            _check_tensor(tensor)


def _check_tensor(tensor: Any) -> None:
    if tensor.data_location == _EXTERNAL or tensor.external_data:
        raise BundleError(
            f"weights {tensor.name[:60]!r} lie in another file: export with external_data=False"
        )


def _check_interface(graph: Any, observation_size: int, action_size: int) -> None:
    weights = {tensor.name for tensor in graph.initializer}
    given = _signature([value for value in graph.input if value.name not in weights])
    made = _signature(graph.output)
    for found, needed, memory in ((given, "observation", "memory_in"), (made, "action", "memory_out")):
        for name in found:
            if name not in (needed, memory):
                raise BundleError(
                    f"no input or output {name[:60]!r} is allowed{hint(name, (needed, memory))}"
                )
        if needed not in found:
            raise BundleError(f"{needed!r} is missing: use input_names, output_names of torch.onnx.export")
    for found, name, size in ((given, "observation", observation_size), (made, "action", action_size)):
        if len(found[name]) != 2 or found[name][0] not in (-1, 1) or found[name][1] not in (-1, size):
            raise BundleError(f"{name} must be (1, {size}) or (batch, {size}), got {found[name]}")
    memories = given.get("memory_in"), made.get("memory_out")
    if (memories[0] is None) != (memories[1] is None):
        raise BundleError("'memory_in' and 'memory_out' are only allowed together")
    if memories[0] is not None:
        size = memories[0][1:]
        if len(size) != 1 or memories[0][0] not in (-1, 1) or not 0 < size[0] <= _WIDEST:
            raise BundleError(f"memory_in must be (1, H) or (batch, H) with a number H, got {memories[0]}")


def _signature(values: Sequence[Any]) -> dict[str, Dims]:
    """Name to shape of inputs or outputs."""
    found: dict[str, Dims] = {}
    for value in values:
        tensor = value.type.tensor_type
        if tensor.elem_type != _FLOAT:
            raise BundleError(f"{value.name[:60]!r} must be a float32 tensor")
        found[value.name] = tuple(
            dim.dim_value if dim.HasField("dim_value") else -1 for dim in tensor.shape.dim
        )
    return found
