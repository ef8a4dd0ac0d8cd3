"""What a sandbox is worth here, found by doing what it must refuse. Version numbers are not believed."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Generator
from pathlib import Path

import numpy as np

from hipg_bench.errors import AgentFailure, HostFailure, SandboxError
from hipg_bench.sandbox.backend import Backend
from hipg_bench.sandbox.budget import Budget
from hipg_bench.sandbox.inside.probe_runner import ATTEMPTS
from hipg_bench.sandbox.process import Child

_BUDGET = Budget(start_up=20.0)
_SECONDS = 20.0


@dataclasses.dataclass(frozen=True)
class ProbeResult:
    """How a sandbox did.

    Attributes:
        let_through: what it should have refused.
        trouble: why it could not be tried, empty where it could.
        seconds: how long the trial took.
    """

    let_through: tuple[str, ...] = ()
    trouble: str = ""
    seconds: float = 0.0

    @property
    def works(self) -> bool:
        """Whether it refused everything."""
        return not self.let_through and not self.trouble

    def __str__(self) -> str:
        if self.trouble:
            return self.trouble
        if self.let_through:
            return f"lets through {', '.join(self.let_through)}"
        return f"refuses {', '.join(ATTEMPTS)}"


@functools.cache
def probe_backend(backend: Backend) -> ProbeResult:
    """Try a sandbox; a process asks once."""
    started = time.monotonic()
    try:
        through = _attempt(backend)
    except (AgentFailure, HostFailure, SandboxError) as failure:
        return ProbeResult(trouble=str(failure), seconds=time.monotonic() - started)
    return ProbeResult(through, seconds=time.monotonic() - started)


def _attempt(backend: Backend) -> tuple[str, ...]:
    """Let a child try everything at targets of ours; believe what it says and what we see."""
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="hipg-probe-")))
        (folder / "agent").mkdir()
        (folder / "secret").write_text("a salt")
        victim = stack.enter_context(_sleeper())
        tcp = stack.enter_context(socket.create_server(("127.0.0.1", 0)))
        udp = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
        udp.bind(("127.0.0.1", 0))
        for receiver in (tcp, udp):
            receiver.setblocking(False)
        targets = {
            "file": str(folder / "secret"), "outside": str(folder / "written"), "process": victim.pid,
            "tcp": tcp.getsockname()[1], "udp": udp.getsockname()[1],
        }  # fmt: skip
        setup = {"runner": "probe_runner", "options": targets}
        child = Child(backend, folder / "agent", setup, _BUDGET)
        stack.callback(child.kill)
        child.ask({"do": "reset"}, [np.zeros(1, np.int64).tobytes()], _SECONDS)
        _, payload = child.ask(
            {"do": "act", "shape": [1, 1, 1]}, [bytes(4), bytes(1)], _SECONDS, most=8 * len(ATTEMPTS)
        )
        said = np.frombuffer(payload, np.float64)
        seen = {
            "write a file": (folder / "written").exists(),
            "TCP": _heard(tcp.accept),
            "UDP": _heard(lambda: udp.recv(1)),
            "a signal": victim.poll() is not None,
        }
    return tuple(name for name, done in zip(ATTEMPTS, said, strict=True) if done or seen.get(name, False))


@contextlib.contextmanager
def _sleeper() -> Generator[subprocess.Popen[bytes]]:
    """A process that it is no loss to kill."""
    process = subprocess.Popen(
        [sys.executable, "-I", "-S", "-c", "import time; time.sleep(100)"], stdin=subprocess.DEVNULL
    )
    try:
        yield process
    finally:
        process.kill()
        process.wait()


def _heard(listen: Callable[[], object]) -> bool:
    with contextlib.suppress(BlockingIOError):
        listen()
        return True
    return False
