"""A child process from the parent's side: pipes that never block, clocks that the child cannot touch.

All that comes from the child is untrusted: lengths are checked before anything is kept, and of what it
prints the last 64 KB are kept and the rest is dropped, so that it can neither block nor fill memory.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import select
import shutil
import signal
import subprocess
import time
import weakref
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from hipg_bench.errors import AgentFailure, HostFailure
from hipg_bench.sandbox.backend import ENVIRONMENT, Backend
from hipg_bench.sandbox.budget import Budget
from hipg_bench.sandbox.files import private_copy
from hipg_bench.sandbox.inside import wire

_MOST_HEADER = 16 << 10
_PIPE = 1 << 20
_START_SECONDS = 60.0
_CHUNK = 256 << 10
_SET_PIPE_SIZE = getattr(fcntl, "F_SETPIPE_SZ", 1031)

Part = bytes | memoryview


class Child:
    """One confined process.

    Attributes:
        words: what it printed, the last 64 KB.
    """

    def __init__(self, backend: Backend, folder: Path, setup: Mapping[str, Any], budget: Budget) -> None:
        """Start it. It gets ready by itself; the first `ask` waits until it is.

        Args:
            backend: how it is locked in.
            folder: the submission's. The child sees a fresh copy of what belongs to it, so that nothing that
                one leaves on a file, such as the time of its reading, is met by the next.
            setup: what its runner is told: ``runner``, ``options``, ``task``, ``train_seed``.
            budget: its limits.

        Raises:
            HostFailure: it could not be started.
        """
        self.words = bytearray()
        self._budget = budget
        self._came = bytearray()
        self._ready = False
        place = private_copy(folder)
        start = backend(place)
        try:
            self._process = subprocess.Popen(
                start.command,
                stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
                env=dict(ENVIRONMENT), cwd="/", start_new_session=True, bufsize=0,
            )  # fmt: skip
        except OSError as error:
            shutil.rmtree(place, ignore_errors=True)
            raise HostFailure(f"a child process could not be started: {error}") from error
        self._finalize = weakref.finalize(self, _end, self._process, os.getpid(), place)
        self._in, self._out, self._err = (
            stream.fileno()
            for stream in (self._process.stdin, self._process.stdout, self._process.stderr)
            if stream is not None
        )
        for end in (self._in, self._out, self._err):
            os.set_blocking(end, False)
            with contextlib.suppress(OSError):  # above the user's limit: smaller pipes do, slower
                fcntl.fcntl(end, _SET_PIPE_SIZE, _PIPE)
        self._poll = select.poll()
        self._poll.register(self._out, select.POLLIN)
        self._poll.register(self._err, select.POLLIN)
        # an empty pipe takes this at once; if the process has ended already, the first `ask` finds out
        with contextlib.suppress(BrokenPipeError):
            os.write(self._in, wire.message(start.setup | dict(setup) | {"memory": budget.memory}))

    def ask(
        self, header: Mapping[str, Any], parts: Sequence[Part], seconds: float, most: int = 0
    ) -> tuple[wire.Header, memoryview]:
        """Send a message, wait for the answer.

        Args:
            header: of the message.
            parts: bytes that follow it.
            seconds: how long both may take together, once the child is locked in.
            most: bytes that may follow the answer's header.

        Raises:
            AgentFailure: no answer in time, the end of the process, or an answer that is none. The child
                is killed.
            HostFailure: the same before anything of the agent has run.
        """
        if not self._ready:
            self._await_start()
        deadline = time.monotonic() + seconds
        size = sum(memoryview(part).nbytes for part in parts)
        try:
            self._send([wire.message(header, size), *parts], deadline)
            return self._receive(deadline, most)
        except AgentFailure:
            self.kill()
            raise

    def kill(self) -> None:
        """End the process and whatever it started."""
        self._finalize()

    def said(self) -> str:
        """The end of what it printed, fit to be shown."""
        text = bytes(self.words).decode("utf-8", "replace")
        lines = ["".join(c if c.isprintable() else " " for c in line) for line in text.splitlines()]
        return "\n".join(line[:200] for line in lines[-12:])

    def _await_start(self) -> None:
        """Wait until the child is locked in; that is our time, not the agent's."""
        try:
            self._receive(time.monotonic() + _START_SECONDS, 0)
        except AgentFailure as failure:
            self.kill()
            raise HostFailure(f"the sandbox could not be started: {failure}") from failure
        self._ready = True

    def _send(self, parts: Sequence[Part], deadline: float) -> None:
        left = [memoryview(part).cast("B") for part in parts if memoryview(part).nbytes]
        watched = False
        while left:
            try:
                count = os.writev(self._in, left)
            except BlockingIOError:
                if not watched:
                    self._poll.register(self._in, select.POLLOUT)
                    watched = True
                self._wait(deadline)
                continue
            except BrokenPipeError:
                break  # it is at its end; what it said last is read below
            while left and count >= left[0].nbytes:
                count -= left.pop(0).nbytes
            if left:
                left[0] = left[0][count:]
        if watched:
            self._poll.unregister(self._in)

    def _receive(self, deadline: float, most: int) -> tuple[wire.Header, memoryview]:
        while (answer := self._answer(most)) is None:
            for end, _ in self._wait(deadline):
                if end == self._out:
                    self._read_answer()
        header, payload = answer
        if "error" in header:
            self._listen()
            raise AgentFailure("crash", self._with_words(f"it raised {_plain(header['error'])}"))
        return header, payload

    def _answer(self, most: int) -> tuple[wire.Header, memoryview] | None:
        """Take one whole message out of what came, if there is one."""
        came = self._came
        if len(came) < wire.LENGTHS.size:
            return None
        header_size, payload_size = wire.LENGTHS.unpack_from(came)
        if header_size > _MOST_HEADER or payload_size > most:
            raise AgentFailure("wrong_shape", f"it answered with {payload_size} bytes, {most} are allowed")
        end = wire.LENGTHS.size + header_size
        if len(came) < end + payload_size:
            return None
        try:
            header = json.loads(came[wire.LENGTHS.size : end])
        except (ValueError, RecursionError) as error:
            raise AgentFailure("crash", "its answer is not JSON") from error
        if not isinstance(header, dict) or len(came) > end + payload_size:
            raise AgentFailure("crash", "it wrote to the pipe of its answers")
        self._came = bytearray()
        return header, memoryview(came)[end:]

    def _read_answer(self) -> None:
        chunk = os.read(self._out, _CHUNK)
        if not chunk:
            self._listen()
            raise AgentFailure("crash", self._with_words(f"its process ended{self._how()}"))
        self._came += chunk

    def _wait(self, deadline: float) -> list[tuple[int, int]]:
        """Sleep until there is something to do; keep what the child prints."""
        left = deadline - time.monotonic()
        if left <= 0:
            raise AgentFailure("timeout", self._with_words("it did not answer in time"))
        events = self._poll.poll(left * 1000)
        if any(end == self._err for end, _ in events):
            self._listen(at_most=1)
        return [(end, event) for end, event in events if end != self._err]

    def _listen(self, at_most: int = 16) -> None:
        """Read what it printed, some chunks of it; whoever prints without end must not hold us here."""
        for _ in range(at_most):
            try:
                chunk = os.read(self._err, _CHUNK)
            except BlockingIOError:
                return
            if not chunk:
                with contextlib.suppress(KeyError):
                    self._poll.unregister(self._err)
                return
            self.words += chunk
            del self.words[: -self._budget.words]

    def _how(self) -> str:
        """With which signal or status it ended."""
        try:
            code = self._process.wait(0.5)
        except subprocess.TimeoutExpired:
            return ""
        if code < 0 or code > 128:
            number = -code if code < 0 else code - 128
            with contextlib.suppress(ValueError):
                return f" with {signal.Signals(number).name}"
        return f" with status {code}"

    def _with_words(self, text: str) -> str:
        said = self.said()
        return f"{text}; it printed:\n{said}" if said else text


def _end(process: subprocess.Popen[bytes], owner: int, place: Path) -> None:
    """Kill a process and its group, close its pipes, remove its files; a fork of the owner does nothing."""
    if os.getpid() != owner:
        return
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    process.kill()
    process.wait()
    for stream in (process.stdin, process.stdout, process.stderr):
        if stream is not None:
            stream.close()
    shutil.rmtree(place, ignore_errors=True)


def _plain(text: object) -> str:
    return "".join(c if c.isprintable() else " " for c in str(text))[:500]
