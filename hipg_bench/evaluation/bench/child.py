"""Measurements in processes of their own: nothing is warm from before, and memory is theirs alone.

The process is this module, ``python -m hipg_bench.evaluation.bench.child``. It imports nothing heavy
before it has its environment variables and knows what to measure.
"""

from __future__ import annotations

import dataclasses
import pickle
import resource
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from hipg_bench import processes
from hipg_bench.errors import HipgError


class Job(NamedTuple):
    """One measurement.

    Attributes:
        section: where its rows belong.
        function: returns rows, instances of dataclasses; importable by name. Where a row leaves ``peak_mb``
            None, it gets what `peak_memory` says at the end.
        arguments: of the function; they can be pickled.
        environment: variables that the process gets beside this one's.
    """

    section: str
    function: Callable[..., list[Any]]
    arguments: tuple[Any, ...]
    environment: Mapping[str, str] = {}


def run(job: Job) -> list[Any]:
    """Run a job in a fresh process and return its rows.

    Raises:
        HipgError: what the function raised of the kind, or that the process failed, with its last words.
    """
    with tempfile.TemporaryDirectory(prefix="hipg-bench-") as folder:
        asked, answer = Path(folder) / "job", Path(folder) / "rows"
        asked.write_bytes(pickle.dumps((job.function, job.arguments)))
        done = subprocess.run(
            processes.python("-m", __spec__.name, str(asked), str(answer)),
            env=processes.environment(**job.environment), cwd="/",
            stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, check=False,
        )  # fmt: skip
        if done.returncode != 0:
            said = done.stderr.strip().splitlines() or [f"ended with code {done.returncode}"]
            raise HipgError(f"bench {job.section}: {said[-1]}")
        rows = pickle.loads(answer.read_bytes())
    if isinstance(rows, HipgError):
        raise rows
    return rows


def _answer(asked: Path, answer: Path) -> None:
    function, arguments = pickle.loads(asked.read_bytes())
    try:
        rows = [_with_memory(row) for row in function(*arguments)]
    except HipgError as error:
        rows = error
    answer.write_bytes(pickle.dumps(rows))


def _with_memory(row: Any) -> Any:
    unknown = getattr(row, "peak_mb", 0.0) is None
    return dataclasses.replace(row, peak_mb=peak_memory()) if unknown else row


def peak_memory() -> float:
    """Most memory this process ever had resident, MB.

    Linux keeps ``ru_maxrss`` of the process that forked, so there the kernel's own high-water mark is read.
    """
    status = Path("/proc/self/status")
    if status.exists():
        lines = dict(line.split(":", 1) for line in status.read_text().splitlines() if ":" in line)
        return int(lines["VmHWM"].split()[0]) * 1024 / 1e6
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 1e6


if __name__ == "__main__":
    _answer(Path(sys.argv[1]), Path(sys.argv[2]))
