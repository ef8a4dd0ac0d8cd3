"""A single-file PPO in CleanRL's style, on the leaderboard as Python code: docs/guides/submit.md, tier 2.

Run, it trains with cleanrl_ppo.py and writes weights into an agent's folder. It is copied there too, since it
is also the agent's code: its upper half is what is imported, in a process that has no torch loaded.
"""

import argparse
import runpy
import shutil
import sys
from pathlib import Path

import numpy as np


class Team:
    """One network for the whole team: N * O numbers in, N * A out, as Gymnasium's adapter has it."""

    def __init__(self, task: dict, train_seed: int) -> None:
        """Read what training wrote: layers 0, 2 and 4 are linear, with tanh between."""
        with np.load(Path(__file__).parent / task["name"] / f"seed{train_seed}.npz") as file:
            self.layers = [(file[f"{k}.weight"], file[f"{k}.bias"]) for k in (0, 2, 4)]

    def reset(self, seeds: np.ndarray) -> None:
        """Nothing is remembered."""

    def act(self, observation: np.ndarray, alive: np.ndarray) -> np.ndarray:
        """(B, N, O) float32, (B, N) bool to (B, N, A)."""
        hidden = observation.reshape(len(observation), -1).astype(np.float64)
        for weight, bias in self.layers[:-1]:
            hidden = np.tanh(hidden @ weight.T + bias)
        weight, bias = self.layers[-1]
        return np.clip(hidden @ weight.T + bias, -1.0, 1.0).reshape(*alive.shape, -1)


make_agent = Team

if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--agent", type=Path, default=Path("cleanrl_ppo"), help="the folder of `submit init`")
    parser.add_argument("--task", default="coop_nav-3")
    parser.add_argument("--iterations", default="300")
    args = parser.parse_args()
    script = Path(__file__).with_name("cleanrl_ppo.py")
    sys.argv = [script.name, "--task", f"hipg/{args.task}-v1", "--iterations", args.iterations]
    actor = runpy.run_path(str(script))["actor"]
    (args.agent / args.task).mkdir(parents=True, exist_ok=True)
    weights = {name: tensor.numpy() for name, tensor in actor.state_dict().items()}
    np.savez(args.agent / args.task / "seed0.npz", **weights)
    shutil.copy(__file__, args.agent / "agent.py")
