"""The child: lock oneself in, make the agent, answer until the parent hangs up.

    parent: setup                                child: {"ready": true}      (our own start is done)
    parent: {"do": "reset"}, seeds (B,) int64    child: {"ready": true}      (the agent is made and reset)
    parent: {"do": "act"}, observation (B, N, O) float32, alive (B, N) bool
                                                 child: {"shape": [B, N, A]}, action float64
    instead of any answer                        child: {"error": "..."}, and it ends

Whatever the agent prints goes to stderr, so that it cannot end up among the answers.
"""

from __future__ import annotations

import importlib
import os
import sys
import traceback
from collections.abc import Mapping
from typing import Any, Protocol

from . import confine, wire

_RUNNERS = ("python_runner", "onnx_runner", "graph_checker", "probe_runner")


class Answerer(Protocol):
    """What a runner's ``make(setup)`` returns."""

    def reset(self, seeds: Any) -> object:
        """Begin B episodes; seeds (B,) int64."""
        ...

    def act(self, observation: Any, alive: Any) -> Any:
        """Answer (B, N, O) float32 and (B, N) bool with (B, N, A)."""
        ...


def main() -> None:
    """Run to the end of the pipe."""
    source, target = os.dup(0), os.dup(1)
    nothing = os.open(os.devnull, os.O_RDONLY)
    os.dup2(nothing, 0)
    os.close(nothing)
    os.dup2(2, 1)
    setup, _ = wire.receive(source)
    confine.shut(setup)
    sys.path += setup["packages"]
    wire.send(target, {"ready": True})
    try:
        _answer(setup, source, target)
    except EOFError:
        return
    except BaseException as error:  # SystemExit of the agent, too, is a crash
        _print(error)
        wire.send(target, {"error": f"{type(error).__name__}: {error}"[:500]})


def _answer(setup: Mapping[str, Any], source: int, target: int) -> None:
    """Reset once, then act."""
    import numpy as np

    header, payload = wire.receive(source)
    runner = setup["runner"]
    if runner not in _RUNNERS:
        raise ValueError(f"no runner {runner!r}; there are: {_RUNNERS}")
    agent: Answerer = importlib.import_module(f".{runner}", __package__).make(setup)
    agent.reset(np.frombuffer(payload, np.int64))
    wire.send(target, {"ready": True})
    while True:
        header, payload = wire.receive(source)
        worlds, agents, size = header["shape"]
        seen = np.frombuffer(payload, np.float32, worlds * agents * size).reshape(worlds, agents, size)
        alive = np.frombuffer(payload, np.bool_, offset=seen.nbytes).reshape(worlds, agents)
        answer = agent.act(seen, alive)
        try:
            action = np.asarray(answer, np.float64)
        except (TypeError, ValueError):  # no rectangle of numbers
            action = np.empty(())
        said = {"shape": action.shape} if action.ndim else {"kind": type(answer).__name__[:50]}
        wire.send(target, said, action.tobytes())


def _print(error: BaseException) -> None:
    """Print a traceback that begins in the agent's code."""
    place = error.__traceback__
    ours = (os.path.dirname(__file__), os.path.dirname(importlib.__file__), "<frozen importlib")
    while place is not None and place.tb_frame.f_code.co_filename.startswith(ours):
        place = place.tb_next
    traceback.print_exception(type(error), error, place)
    sys.stderr.flush()
