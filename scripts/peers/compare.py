"""Our environments beside others', in one run: contenders take turns in processes of their own.

    scripts/bench_peers.sh [--only NAME] [--rounds N] [--seconds S] [--out runs/peers.json]

Within a group everyone runs for the same time in every round, one after another, while the others sleep; a
ratio is the median of the rounds' own ratios. How many processes and threads each has is in the table.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from hipg_bench.errors import hint
from hipg_bench.evaluation.bench.machine import machine, usable_cores
from hipg_bench.paths import write_text

SCHEMA = 1
_REST = 0.2
"""Seconds between turns, in which threads of the one before go to sleep."""


@dataclasses.dataclass(frozen=True)
class Peer:
    """Another's environment or learner.

    Attributes:
        name: in `contenders.CONTENDERS`.
        bar: how many times as fast ours is to be; None where that is only to be known.
        processes: run at once; for libraries that use one core.
    """

    name: str
    bar: float | None = None
    processes: int = 1


@dataclasses.dataclass(frozen=True)
class Group:
    """What is comparable.

    Attributes:
        title: for the table.
        unit: what is counted.
        ours: our contender.
        peers: the others.
    """

    title: str
    unit: str
    ours: str
    peers: tuple[Peer, ...]


GROUPS = {
    "spread": Group(
        "eight agents cover eight points in the plane, 1,024 worlds", "env-steps/s", "hipg paper_nav-8",
        (Peer("JaxMARL simple_spread", 1.5), Peer("VMAS simple_spread", 4.0)),
    ),
    "walkers-3": Group(
        "three walkers carry a load", "env-steps/s", "hipg multiwalker-3",
        (Peer("PettingZoo multiwalker, 3", 6.0, usable_cores()),),
    ),
    "walkers-5": Group(
        "five walkers carry a load", "env-steps/s", "hipg multiwalker-5",
        (Peer("PettingZoo multiwalker, 5", 6.0, usable_cores()),),
    ),
    "one-world": Group(
        "four agents, one MuJoCo world behind PettingZoo's parallel API", "env-steps/s",
        "hipg hazard_nav-4, PettingZoo", (Peer("MaMuJoCo Ant 4x2", 3.0),),
    ),
    "one-world-of-walkers": Group(
        "three walkers carry a load, one world behind PettingZoo's parallel API", "env-steps/s",
        "hipg multiwalker-3, PettingZoo", (Peer("PettingZoo multiwalker, 3"),),
    ),
    "training": Group(
        "MAPPO on paper_nav-8: rollouts and updates", "agent samples/s", "hipg MAPPO",
        (Peer("TorchRL MAPPO", 3.0),),
    ),
}  # fmt: skip


class Worker:
    """Processes of one contender; rates are summed over them."""

    def __init__(self, name: str, processes: int = 1) -> None:
        self.name = name
        # everybody may use all cores: no limit that this shell happens to have
        variables = {key: value for key, value in os.environ.items() if not key.endswith("_NUM_THREADS")}
        command = [sys.executable, str(Path(__file__).with_name("worker.py")), name]
        self._said = tempfile.TemporaryFile("w+")  # noqa: SIM115 (closed by __exit__)
        self._running = [
            subprocess.Popen(
                command, env=variables, text=True,
                stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=self._said,
            )
            for _ in range(processes)
        ]  # fmt: skip
        self.settings: dict[str, Any] = {**self._answers()[0], "processes": processes}

    def rate(self, seconds: float) -> float:
        """Run for so long; steps per second."""
        time.sleep(_REST)
        for process in self._running:
            process.stdin.write(f"{seconds}\n")
            process.stdin.flush()
        return sum(answer["steps"] / answer["seconds"] for answer in self._answers())

    def __enter__(self) -> Worker:
        return self

    def __exit__(self, *_: object) -> None:
        for process in self._running:
            process.kill()
            process.wait()
        self._said.close()

    def _answers(self) -> list[dict[str, Any]]:
        lines = [process.stdout.readline() for process in self._running]
        if not all(lines):
            self._said.seek(0)
            said = self._said.read().strip().splitlines()
            sys.exit(f"{self.name}: {said[-1] if said else 'ended'}")
        return [json.loads(line) for line in lines]


def compare(group: Group, rounds: int, seconds: float) -> dict[str, Any]:
    """Let ours and the peers take turns; every second round goes backwards."""
    with contextlib.ExitStack() as stack:
        workers = [
            stack.enter_context(Worker(name, processes))
            for name, processes in [(group.ours, 1), *((peer.name, peer.processes) for peer in group.peers)]
        ]
        rates: dict[str, list[float]] = {worker.name: [] for worker in workers}
        for turn in range(rounds):
            for worker in workers if turn % 2 == 0 else reversed(workers):
                rates[worker.name].append(worker.rate(seconds))
    ours = rates[group.ours]
    return {
        "title": group.title,
        "unit": group.unit,
        "ours": group.ours,
        "contenders": [
            {"name": one.name, "rate": statistics.median(rates[one.name]), "rates": rates[one.name],
             "settings": one.settings}
            for one in workers
        ],
        "ratios": [
            _ratio(peer, [a / b for a, b in zip(ours, rates[peer.name], strict=True)])
            for peer in group.peers
        ],
    }  # fmt: skip


def _ratio(peer: Peer, of_rounds: list[float]) -> dict[str, Any]:
    ratio = statistics.median(of_rounds)
    return {
        "over": peer.name, "ratio": ratio, "low": min(of_rounds), "high": max(of_rounds), "bar": peer.bar,
        "met": None if peer.bar is None else ratio >= peer.bar,
    }  # fmt: skip


def show(console: Console, found: dict[str, Any]) -> None:
    """A group's table."""
    rows = Table(
        title=f"\n{found['title']}", title_justify="left", box=None, pad_edge=False, header_style="bold"
    )
    for column in ("", found["unit"], "ours / it", "rounds", "bar"):
        rows.add_column(column, justify="right" if column else "left")
    ratios = {ratio["over"]: ratio for ratio in found["ratios"]}
    for one in found["contenders"]:
        ratio = ratios.get(one["name"])
        rows.add_row(one["name"], f"{one['rate']:,.0f}", *(_read(ratio) if ratio else ()))
    console.print(rows)
    for one in found["contenders"]:
        console.print(f"[dim]{one['name']}: {_told(one['settings'])}[/dim]", soft_wrap=True)


def _read(ratio: dict[str, Any]) -> tuple[str, str, str]:
    bar = "" if ratio["bar"] is None else f"{ratio['bar']:g}{'' if ratio['met'] else ' missed'}"
    return f"{ratio['ratio']:.2f}", f"{ratio['low']:.2f}-{ratio['high']:.2f}", bar


def _told(settings: dict[str, Any]) -> str:
    versions = " ".join(f"{name} {version}" for name, version in settings["versions"].items())
    told = ", ".join(f"{name} {value}" for name, value in settings.items() if name != "versions")
    return f"{told}; {versions}"


def main() -> None:
    """Measure, print, write."""
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--only", action="append", metavar="GROUP", help=f"some of: {', '.join(GROUPS)}")
    options.add_argument("--rounds", type=int, default=7)
    options.add_argument("--seconds", type=float, default=2.0, help="per turn")
    options.add_argument("--out", type=Path, default=Path("runs/peers.json"))
    asked = options.parse_args()
    for name in asked.only or ():
        if name not in GROUPS:
            options.error(f"no group {name!r}{hint(name, GROUPS)}")
    console = Console(highlight=False, width=None if sys.stdout.isatty() else 160)
    document = {
        "schema": SCHEMA,
        "machine": machine(),
        "rounds": asked.rounds,
        "seconds": asked.seconds,
        "groups": [],
    }
    for name in asked.only or GROUPS:
        found = compare(GROUPS[name], asked.rounds, asked.seconds)
        document["groups"].append(found)
        show(console, found)
        write_text(asked.out, json.dumps(document, indent=2) + "\n")
    console.print(f"\n{asked.out}", soft_wrap=True)


if __name__ == "__main__":
    main()
