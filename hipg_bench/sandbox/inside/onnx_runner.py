"""Tier 1: an ONNX graph, asked for one agent of one world at a time.

What it consists of is looked at first; `onnx.checker` and ONNX Runtime, which are large programs in C++, meet
it here, where they can do no harm.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from . import graph_checker


def make(setup: Mapping[str, Any]) -> Any:
    """Load ``options["file"]`` of the submission's folder.

    Raises:
        Exception: the checker or the runtime refuses the graph.
    """
    import onnx
    import onnxruntime

    content = graph_checker.read_graph(setup)
    onnx.checker.check_model(content, full_check=True)
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.use_deterministic_compute = True
    options.log_severity_level = 3
    session = onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
    return _Graph(session, setup["task"]["action_size"])


class _Graph:
    def __init__(self, session: Any, action_size: int) -> None:
        self._session = session
        self._action_size = action_size
        self._memory_shape = next(
            ((1, given.shape[1]) for given in session.get_inputs() if given.name == "memory_in"), None
        )
        self._outputs = ["action"] if self._memory_shape is None else ["action", "memory_out"]
        self._memory: dict[tuple[int, int], Any] = {}

    def reset(self, seeds: Any) -> None:
        """Nothing is remembered, and nothing is drawn."""
        self._memory = {}

    def act(self, observation: Any, alive: Any) -> Any:
        """Ask for every live agent by itself."""
        import numpy as np

        action = np.zeros((*alive.shape, self._action_size), np.float32)
        for world, agent in np.argwhere(alive).tolist():
            given = {"observation": observation[world, agent : agent + 1]}
            if self._memory_shape is not None:
                zeros = np.zeros(self._memory_shape, np.float32)
                given["memory_in"] = self._memory.get((world, agent), zeros)
            out = self._session.run(self._outputs, given)
            if np.shape(out[0]) != (1, self._action_size):
                raise ValueError(f"action must be (1, {self._action_size}), got {np.shape(out[0])}")
            action[world, agent] = out[0][0]
            if self._memory_shape is not None:
                self._memory[world, agent] = out[1]
        return action
