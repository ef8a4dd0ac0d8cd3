"""What an ONNX graph of others may consist of, found by reading it, without running it.

Reading takes many times the file's size in memory, hence here, in the sandboxed child; `onnx.checker` and
ONNX Runtime follow in `onnx_runner`. The graph is asked for one agent of one world at a time, so no graph can
let agents know more than they see, nor can actions depend on the batch.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

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


class GraphError(Exception):
    """A graph that is not allowed; the message says why, and what is."""


def make(setup: Mapping[str, Any]) -> Any:
    """As a runner of its own: check ``options["file"]`` and answer nothing else.

    Raises:
        GraphError: the file is not a graph that may be run.
    """
    read_graph(setup)
    return _Checked()


class _Checked:
    def reset(self, seeds: Any) -> None:
        """It is allowed."""

    def act(self, observation: Any, alive: Any) -> Any:
        """Nothing is run."""
        raise NotImplementedError


def read_graph(setup: Mapping[str, Any]) -> bytes:
    """The bytes of a graph from ``observation`` (1, O) to ``action`` (1, A).

    It may also have ``memory_in`` and ``memory_out``, of one shape, which is what an agent remembers (zeros
    at the start). All are float32; the first axis is 1 or has a name.

    Raises:
        GraphError: it is not such a graph, or holds what may not be run.
    """
    import onnx
    from google.protobuf.message import DecodeError

    content = (Path(setup["folder"]) / setup["options"]["file"]).read_bytes()
    model = onnx.ModelProto()
    try:
        model.ParseFromString(content)
    except (DecodeError, RecursionError, MemoryError) as error:
        raise GraphError("not an ONNX file, or one nested too deeply") from error
    _check_model(model)
    _check_interface(model.graph, setup["task"]["observation_size"], setup["task"]["action_size"])
    return content


def _check_model(model: Any) -> None:
    """Refuse what may not be run."""
    versions = {entry.domain: entry.version for entry in model.opset_import}
    for domain, version in versions.items():
        if domain not in _DOMAINS:
            raise GraphError(f"operators of the domain {domain!r} are not allowed, only ONNX's own")
        if version not in OPSETS:
            raise GraphError(f"opset {OPSETS[0]} to {OPSETS[-1]} is allowed, got {version}: export again")
    if not versions or len(versions) < len(model.opset_import):
        raise GraphError("it must name one opset")
    if model.functions or model.training_info:
        raise GraphError("functions and training steps of its own are not allowed: export it inlined")
    nodes = 0
    for graph in _graphs(model.graph):
        if graph.sparse_initializer:
            raise GraphError("sparse weights are not allowed")
        nodes += len(graph.node)
        for tensor in graph.initializer:
            _check_tensor(tensor)
        for node in graph.node:
            _check_node(node)
    if not 0 < nodes <= _MOST_NODES:
        raise GraphError(f"1 to {_MOST_NODES} operators are allowed, got {nodes}")


def _graphs(graph: Any) -> Iterator[Any]:
    """A graph and those in the branches and loops of its nodes."""
    yield graph
    for node in graph.node:
        for attribute in node.attribute:
            for inner in (*([attribute.g] if attribute.HasField("g") else []), *attribute.graphs):
                yield from _graphs(inner)


def _check_node(node: Any) -> None:
    if node.domain not in _DOMAINS:
        raise GraphError(f"operator {node.op_type!r} of the domain {node.domain!r} is not allowed")
    if node.op_type in _CHANCE or (node.op_type == "Dropout" and len(node.input) > 2 and node.input[2]):
        raise GraphError(
            f"operator {node.op_type!r} is not allowed: actions must not be drawn at random; export in "
            f"evaluation mode"
        )
    for attribute in node.attribute:
        if attribute.HasField("sparse_tensor") or attribute.sparse_tensors:
            raise GraphError("sparse weights are not allowed")
        for tensor in (*([attribute.t] if attribute.HasField("t") else []), *attribute.tensors):
            _check_tensor(tensor)


def _check_tensor(tensor: Any) -> None:
    if tensor.data_location == _EXTERNAL or tensor.external_data:
        raise GraphError(f"weights {tensor.name[:60]!r} lie in another file: export with external_data=False")


def _check_interface(graph: Any, observation_size: int, action_size: int) -> None:
    weights = {tensor.name for tensor in graph.initializer}
    given = _signature([value for value in graph.input if value.name not in weights])
    made = _signature(graph.output)
    for found, needed, memory in ((given, "observation", "memory_in"), (made, "action", "memory_out")):
        for name in found:
            if name not in (needed, memory):
                raise GraphError(
                    f"no input or output {name[:60]!r} is allowed; "
                    f"did you mean {_nearest(name, needed, memory)!r}?"
                )
        if needed not in found:
            raise GraphError(f"{needed!r} is missing: use input_names, output_names of torch.onnx.export")
    for found, name, size in ((given, "observation", observation_size), (made, "action", action_size)):
        if len(found[name]) != 2 or found[name][0] not in (-1, 1) or found[name][1] not in (-1, size):
            raise GraphError(f"{name} must be (1, {size}) or (batch, {size}), got {found[name]}")
    memories = given.get("memory_in"), made.get("memory_out")
    if (memories[0] is None) != (memories[1] is None):
        raise GraphError("'memory_in' and 'memory_out' are only allowed together")
    if memories[0] is not None:
        size = memories[0][1:]
        if len(size) != 1 or memories[0][0] not in (-1, 1) or not 0 < size[0] <= _WIDEST:
            raise GraphError(f"memory_in must be (1, H) or (batch, H) with a number H, got {memories[0]}")


def _nearest(name: str, *allowed: str) -> str:
    return (difflib.get_close_matches(name, allowed, 1, 0.0) or [allowed[0]])[0]


def _signature(values: Sequence[Any]) -> dict[str, Dims]:
    """Name to shape of inputs or outputs."""
    found: dict[str, Dims] = {}
    for value in values:
        tensor = value.type.tensor_type
        if tensor.elem_type != _FLOAT:
            raise GraphError(f"{value.name[:60]!r} must be a float32 tensor")
        found[value.name] = tuple(
            dim.dim_value if dim.HasField("dim_value") else -1 for dim in tensor.shape.dim
        )
    return found
