"""What the sandbox costs: a network in this process, and the same as a tier-2 agent behind pipes, by turns.

    python scripts/sandbox_overhead.py --tasks hazard_nav-8 multiwalker-3 --rounds 5 --worlds 64

Wall-clock and processor time of whole batches of episodes, the child's included. The rows must be the same.
On a machine that is busy with other things wall-clock time says more about these: look at the processor's.
"""

import argparse
import os
import statistics
import tempfile
import time
from pathlib import Path

import numpy as np
from rich.console import Console

from hipg_bench import registry
from hipg_bench.evaluation.episodes import EvaluationJob
from hipg_bench.policies.bundle import load_agent
from hipg_bench.policies.foreign import ForeignPolicy
from hipg_bench.policies.policy import Policy
from hipg_bench.spec import TaskSpec

AGENT = '''
import numpy as np
from safetensors.numpy import load_file


class Network:
    """A policy file of the package: float64, clipped normalised observations, tanh layers."""

    def __init__(self, path):
        wide = {name: tensor.astype(np.float64) for name, tensor in load_file(path).items()}
        self.mean, self.scale = wide["observation.mean"], wide["observation.scale"]
        depth = sum(name.endswith(".weight") for name in wide)
        self.layers = [(wide[f"layer{k}.weight"].T, wide[f"layer{k}.bias"]) for k in range(depth)]

    def reset(self, seeds):
        pass

    def act(self, observation, alive):
        hidden = np.clip((observation - self.mean) / self.scale, -10.0, 10.0)
        for weight, bias in self.layers[:-1]:
            hidden = np.tanh(hidden @ weight + bias)
        weight, bias = self.layers[-1]
        return np.clip(hidden @ weight + bias, -1.0, 1.0)


def make_agent(task, train_seed):
    return Network(__file__.replace("agent.py", "weights.safetensors"))
'''


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description="what the sandbox costs")
    parser.add_argument("--agent", default="mappo_minhealth", help="a bundled network")
    parser.add_argument("--tasks", nargs="+", default=["hazard_nav-8", "multiwalker-3"])
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--worlds", type=int, default=64)
    asked = parser.parse_args()
    bundle = load_agent(asked.agent)
    for task in asked.tasks:
        spec = registry.tasks()[task]
        train_seed = bundle.train_seeds(task)[0]
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            (folder / "agent.py").write_text(AGENT)
            weights = bundle.folder / task / f"seed{train_seed}.safetensors"
            (folder / "weights.safetensors").write_bytes(weights.read_bytes())
            inside = Counted(
                spec, folder, train_seed, runner="python_runner", options={"entry_point": "agent:make_agent"}
            )
            compare(spec, bundle.policy(spec, train_seed), inside, asked.rounds, asked.worlds)


class Counted(ForeignPolicy):
    """Notes the processor time of its children before they are killed, which then tell no one."""

    def close(self) -> None:
        """As the base does."""
        for pid in descendants(os.getpid()):
            fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
            SPENT[pid] = (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
        super().close()


SPENT: dict[int, float] = {}
"""Seconds of the processor by child."""


def compare(spec: TaskSpec, here: Policy, inside: ForeignPolicy, rounds: int, worlds: int) -> None:
    """Play the same batch by turns."""
    job = EvaluationJob(episodes=worlds, num_envs=worlds)
    found: list[list[np.ndarray]] = [[], []]
    results = []
    for k in range(rounds + 1):
        for policy, laps in zip((here, inside), found, strict=True):
            started = clocks()
            results.append(job.play_all(spec, policy))
            if k:  # the first round warms caches
                laps.append(clocks() - started)
    same = all(rows == results[0] for rows in results)
    out = Console(highlight=False)
    out.print(f"{spec.task}, {worlds} worlds, {rounds} rounds, rows {'the same' if same else 'DIFFER'}")
    for how, of in (("median", statistics.median), ("least", min)):
        (plain, plain_cpu), (wall, cpu) = ([of(column) for column in np.array(laps).T] for laps in found)
        out.print(
            f"  {how}: {plain:.2f} s in process, {wall:.2f} s in {inside.sandbox}, {wall / plain - 1:+.1%}; "
            f"processor {plain_cpu:.2f} and {cpu:.2f} s ({cpu / plain_cpu - 1:+.1%})",
            soft_wrap=True,
        )


def clocks() -> np.ndarray:
    """Wall-clock and processor time, s."""
    return np.array([time.perf_counter(), time.process_time() + sum(SPENT.values())])


def descendants(pid: int) -> list[int]:
    """Its children, and theirs."""
    found = []
    for task in Path(f"/proc/{pid}/task").iterdir():
        for child in (task / "children").read_text().split():
            found += [int(child), *descendants(int(child))]
    return found


if __name__ == "__main__":
    main()
