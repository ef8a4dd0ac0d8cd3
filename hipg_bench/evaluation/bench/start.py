"""How long it takes until something happens: imports and the command line, in fresh processes."""

from __future__ import annotations

import collections
import dataclasses
import subprocess
from collections.abc import Callable, Mapping

from hipg_bench import processes
from hipg_bench.evaluation.bench.timing import Contender, in_turn

_NAMED = 4
"""Packages named."""
_PYTHON = "python -c pass"
_CLI = "from hipg_bench.cli import main; import sys; sys.argv[1:] = {}; main()"
CODE: Mapping[str, str] = {
    "import hipg_bench": "import hipg_bench",
    "import mujoco": "import mujoco",
    "hipg_bench.make": "import hipg_bench; hipg_bench.make('hazard_nav-4', 64).reset()",
    "import hipg_bench.learning.run": "import hipg_bench.learning.run",
    "hipg-bench --help": _CLI.format("['--help']"),
    "hipg-bench tasks": _CLI.format("['tasks']"),
}


@dataclasses.dataclass(frozen=True)
class Start:
    """One way to begin.

    Attributes:
        what: code or command.
        ms: of a whole process.
        beyond_python_ms: how much of that a Python which does nothing does not take.
        imports: the packages whose modules took longest to import, with ms.
    """

    what: str
    ms: float
    beyond_python_ms: float
    imports: str


def start_times(seconds: float, code: Mapping[str, str] = CODE) -> list[Start]:
    """Start a process for each piece of code in turn, for ``seconds`` in all and at least three times."""
    code = {_PYTHON: "pass", **code}
    times = in_turn({what: Contender(_process(text)) for what, text in code.items()}, seconds, calls=1)
    python = times.median(_PYTHON)
    return [
        Start(what, 1e3 * times.median(what), 1e3 * (times.median(what) - python), _slowest_imports(text))
        for what, text in code.items()
    ]


def _process(code: str) -> Callable[[], object]:
    command = processes.python("-c", code)
    return lambda: subprocess.run(command, check=True, stdout=subprocess.DEVNULL, env=processes.environment())


def _slowest_imports(code: str) -> str:
    """Packages by the time that their modules' own code took, from ``-X importtime``."""
    said = subprocess.run(
        processes.python("-X", "importtime", "-c", code), env=processes.environment(),
        check=True, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True,
    ).stderr  # fmt: skip
    own: dict[str, float] = collections.defaultdict(float)
    for line in said.splitlines():
        # import time: self [us] | cumulative | imported module
        parts = line.removeprefix("import time:").split("|")
        if len(parts) == 3 and parts[0].strip().isdecimal():
            own[parts[2].strip().split(".")[0]] += int(parts[0]) / 1e3
    slowest = sorted(own, key=own.__getitem__, reverse=True)[:_NAMED]
    return ", ".join(f"{name} {own[name]:.0f}" for name in slowest)
