"""Agents of others for the tests: source text in a folder, played by a `ForeignPolicy`."""

import functools
import textwrap
from pathlib import Path

import numpy as np

from hipg_bench import registry
from hipg_bench.policies.foreign import ForeignPolicy
from hipg_bench.sandbox import choice
from hipg_bench.sandbox.budget import Budget

WORKING = [name for name, result in choice.probe_all().items() if result.works]
"""Sandboxes that work on this machine, the best first."""
TASK = registry.tasks()["hazard_nav-4"]
N, SEEN, A = (
    4,
    registry.definition_of(TASK).layout.observation.size,
    registry.definition_of(TASK).layout.action.size,
)


def policy(folder, source=None, *, spec=TASK, trust=False, budget=None, train_seed=0):
    """The agent of ``folder``/agent.py, written first where its source is given."""
    if source is not None:
        (folder / "agent.py").write_text(textwrap.dedent(source))
    return ForeignPolicy(
        spec, folder, train_seed, runner="python_runner", options={"entry_point": "agent:make_agent"},
        trust=trust, budget=budget or Budget(),
    )  # fmt: skip


def acting(body):
    """Source of an agent whose `act` is ``body``."""
    return (
        "import os, sys, time\nimport numpy as np\n\nclass Agent:\n    def reset(self, seeds):\n"
        "        self.seeds, self.calls = seeds, 0\n\n    def act(self, observation, alive):\n"
        f"        self.calls += 1\n{textwrap.indent(textwrap.dedent(body), ' ' * 8)}\n\n"
        "def make_agent(task, train_seed):\n    return Agent()\n"
    )


def step(agent, worlds=2, seed=5, steps=1, alive=None, spec=TASK):
    """Begin episodes and act some times on the same observation; return the last action and the session."""
    ids = np.arange(worlds)
    session = agent.initial_state(seed, ids, spec.num_agents)
    chance = np.random.default_rng(1)
    size = registry.definition_of(spec).layout.observation.size
    observation = chance.normal(size=(worlds, spec.num_agents, size)).astype(np.float32)
    if alive is None:
        alive = np.ones((worlds, spec.num_agents), bool)
    act = functools.partial(agent.act, observation)
    for _ in range(steps):
        action, session = act(session, alive)
    return action, session


def descendants(pid):
    """Its children, and theirs."""
    found = []
    for task in Path(f"/proc/{pid}/task").iterdir():
        for child in (task / "children").read_text().split():
            found += [int(child), *descendants(int(child))]
    return found
