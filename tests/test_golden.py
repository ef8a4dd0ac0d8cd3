"""Two short episodes of every task, recorded: behaviour changes on purpose or not at all.

`make golden` records them again. Results are bit for bit the same with the pinned engine and array library on
the machines of `hipg_bench.evaluation.machines`; on others these tests skip and say why.
"""

from __future__ import annotations

import hashlib
import json
import os
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from play import actions, strike

import hipg_bench
from hipg_bench import make, task_spec
from hipg_bench.evaluation import machines

FOLDER = Path(__file__).parent / "golden"
STEPS = 40
TASKS = sorted(hipg_bench.tasks())


def versions() -> dict[str, str]:
    """What the last bits of a result depend on beside the code and the machine."""
    return {"mujoco": mujoco.__version__, "numpy": np.__version__}


def episodes(task: str) -> dict[str, Any]:
    """Play worlds 0 and 1 and write down what happened: exactly as digests, legibly as numbers."""
    env = make(task, 2, threads=1)
    step, digests, returns = env.reset(), [], np.zeros(2)
    deaths, ends = [[], []], ["", ""]
    for t in range(1, STEPS + 1):
        was = step.info["alive"]
        step = env.step(actions(env, strike(env, step)))
        returns += step.reward
        for world in range(2):
            for agent in np.flatnonzero(was[world] & ~step.info["final_alive"][world]).tolist():
                deaths[world].append({"step": t, "agent": agent})
            ends[world] = ends[world] or str(step.info["end_reason"][world])
        if t % 10 == 0:
            seen = step.observation.tobytes() + step.info["state"].tobytes() + env.rows.tobytes()
            digests.append(hashlib.sha256(seen).hexdigest()[:16])
    return {
        "version": task_spec(task).version,
        "fingerprint": task_spec(task).fingerprint,
        "returns": returns.tolist(),
        "deaths": deaths,
        "end_reasons": ends,
        "digests_of_every_tenth_step": digests,
    }


@pytest.mark.parametrize("task", TASKS)
def test_golden_episodes(task: str, request: pytest.FixtureRequest):
    path = FOLDER / f"{task}.json"
    if request.config.getoption("--record-golden"):
        temporary = path.with_suffix(".tmp")
        temporary.write_text(json.dumps({"versions": versions(), **episodes(task)}, indent=2) + "\n")
        os.replace(temporary, path)
        pytest.skip("recorded")
    assert path.exists(), f"{path} is missing: record it with `make golden`"
    golden = json.loads(path.read_text())
    spec = task_spec(task)
    assert golden["fingerprint"] == spec.fingerprint, (
        f"the numbers of {task} changed: raise its version, then `make golden`"
    )
    assert golden.pop("versions") == versions(), "install the pinned versions: make setup"
    differs = machines.why_rows_may_differ()
    if differs and request.config.getoption("--strict-golden"):
        pytest.fail(f"{differs}: freeze the suite on such a machine")
    if differs:
        pytest.skip(differs)
    assert episodes(task) == golden, f"{task} behaves differently: if that is wanted, `make golden`"


def test_no_golden_file_is_left_over():
    assert {path.stem for path in FOLDER.glob("*.json")} <= set(TASKS)
