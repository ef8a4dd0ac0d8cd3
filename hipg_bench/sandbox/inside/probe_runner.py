"""Tries to do what no agent may. Its action says, attempt by attempt, what succeeded."""

from __future__ import annotations

import os
import signal
import socket
import threading
import time
from collections.abc import Callable, Mapping
from typing import Any

ATTEMPTS = ("read a file", "read another process", "write a file", "TCP", "UDP", "a signal", "processes",
            "threads", "4 GB of memory")  # fmt: skip
_MANY = 64
_HUGE = 4 << 30


def make(setup: Mapping[str, Any]) -> Any:
    """Return the attempts as an agent; ``options`` name their targets."""
    return _Attempts(setup["options"])


class _Attempts:
    def __init__(self, targets: Mapping[str, Any]) -> None:
        self._attempts: list[Callable[[], object]] = [
            lambda: _read(targets["file"]),
            lambda: _read(f"/proc/{targets['process']}/environ"),
            lambda: _write(targets["outside"]),
            lambda: socket.create_connection(("127.0.0.1", targets["tcp"]), 1.0).close(),
            lambda: _say(targets["udp"]),
            lambda: os.kill(targets["process"], signal.SIGKILL),
            _processes,
            _threads,
            lambda: bytearray(_HUGE),
        ]

    def reset(self, seeds: Any) -> None:
        """Nothing to begin."""

    def act(self, observation: Any, alive: Any) -> Any:
        """(1, 1, attempts): 1 where one succeeded."""
        return [[[float(_succeeds(attempt)) for attempt in self._attempts]]]


def _succeeds(attempt: Callable[[], object]) -> bool:
    try:
        attempt()
    except (OSError, MemoryError, RuntimeError):
        return False
    return True


def _read(path: str) -> None:
    with open(path, "rb") as file:
        file.read(1)


def _write(path: str) -> None:
    with open(path, "wb") as file:
        file.write(b"x")


def _say(port: int) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        sender.sendto(b"x", ("127.0.0.1", port))


def _processes() -> None:
    """Start many.

    Raises:
        OSError: there is a limit.
    """
    for _ in range(_MANY):
        if os.fork() == 0:
            time.sleep(2.0)
            os._exit(0)


def _threads() -> None:
    """Start many.

    Raises:
        RuntimeError: there is a limit.
    """
    for _ in range(_MANY):
        threading.Thread(target=time.sleep, args=(2.0,), daemon=True).start()
