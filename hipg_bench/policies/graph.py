"""ONNX graphs of others, looked at before they play: by a sandboxed child, since reading one takes memory."""

from __future__ import annotations

import hashlib
import re
from pathlib import Path

from hipg_bench.errors import AgentFailure, BundleError, HostFailure
from hipg_bench.policies.foreign import told
from hipg_bench.sandbox import choice
from hipg_bench.sandbox.budget import PROTOCOL
from hipg_bench.sandbox.process import Child
from hipg_bench.spec import TaskSpec

MOST_BYTES = 64_000_000
"""Of a graph with its weights."""
_MISSING = "ModuleNotFoundError"


def check_graph(path: Path, spec: TaskSpec, *, trust: bool = False) -> None:
    """Refuse a file that is not a graph which may play a task; see `sandbox.inside.graph_checker`.

    Args:
        path: the file.
        spec: the task.
        trust: read it without a sandbox.

    Raises:
        BundleError: it is not, it holds what may not be run, or the package ``onnx`` is missing.
        SandboxError: no sandbox works here.
    """
    size = path.stat().st_size
    if size > MOST_BYTES:
        raise BundleError(f"{path}: at most {MOST_BYTES} bytes are allowed, got {size}")
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    seen = (digest, spec.fingerprint)
    if seen not in _faults:
        _faults[seen] = _fault(path, spec, trust)
    if _faults[seen]:
        raise BundleError(f"{path}: {_faults[seen]}")


_faults: dict[tuple[str, str], str] = {}
"""What was found: a file's hash and a task's fingerprint to what is wrong, empty if nothing is."""


def _fault(path: Path, spec: TaskSpec, trust: bool) -> str:
    sandbox = choice.NONE if trust else choice.sandbox()
    setup = told(spec, 0, "graph_checker", {"file": path.name})
    child = Child(choice.BACKENDS[sandbox], path.parent, setup, PROTOCOL)
    try:
        child.ask({"do": "reset"}, [bytes(8)], PROTOCOL.start_up)
    except AgentFailure as failure:
        said = str(failure).partition("; it printed:")[0]
        if _MISSING in said:
            return "ONNX agents need: pip install 'hipg-bench[onnx]'"
        return re.sub(r"^it raised \w+: ", "", said)
    except HostFailure as failure:
        raise BundleError(f"{path} could not be looked at: {failure}") from failure
    finally:
        child.kill()
    return ""
