"""Compiled loops: what they return, where their code is kept, and how work is shared out over threads."""

import os
import subprocess
import sys
import threading

import numpy as np
import pytest

from hipg_bench.native import compiled, on_threads

OFFSET = 3


@compiled
def shifted(number):
    return number + OFFSET


@compiled
def total(numbers):
    result = 0.0
    for k in range(len(numbers)):
        result += shifted(numbers[k])
    return result


def test_compiled_functions_call_each_other():
    # 1 + 2 + 3.5, and three times the offset
    assert total(np.array([1.0, 2.0, 3.5])) == 15.5
    assert total.__name__ == "total"


STEP = """
import hipg_bench, numpy as np
env = hipg_bench.make("paper_nav-4", num_envs=3, threads=1)
env.reset()
print(env.step(np.ones((3, 4, 2))).reward.tobytes().hex())
"""


def stepped(**environment: str) -> str:
    done = subprocess.run(
        [sys.executable, "-c", STEP],
        env=os.environ | environment,
        capture_output=True,
        text=True,
        timeout=100,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_worlds_step_alike_where_machine_code_cannot_be_kept(tmp_path):
    kept = stepped(NUMBA_CACHE_DIR=str(tmp_path))
    assert any(tmp_path.rglob("*.nbi"))
    # of all places, only the one that the user names is tried, and none is named
    nowhere = stepped(NUMBA_CACHE_LOCATOR_CLASSES="UserProvidedCacheLocator", NUMBA_CACHE_DIR="")
    assert nowhere == kept


def test_the_package_and_its_tasks_are_there_without_the_compiler():
    code = "import sys, hipg_bench; hipg_bench.tasks(); print('numba' in sys.modules)"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True
    )
    assert done.stdout.split() == ["False"]


@pytest.mark.parametrize("worlds", [0, 1, 127, 128, 300, 1024])
@pytest.mark.parametrize("threads", [1, 2, 5])
def test_every_world_is_worked_on_once(worlds, threads):
    visits, workers = np.zeros(worlds, int), set()

    def work(part):
        visits[part] += 1
        workers.add(threading.get_ident())

    on_threads(work, worlds, threads)
    assert (visits == 1).all()
    assert len(workers) <= min(threads, max(1, worlds // 128))


def test_what_a_thread_raises_is_raised():
    def work(part):
        if part.start > 0:
            raise ValueError("in the second part")

    with pytest.raises(ValueError, match="second part"):
        on_threads(work, 1000, 2)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork here")
def test_a_forked_child_has_threads_of_its_own():
    parts = []
    on_threads(parts.append, 1000, 2)
    child = os.fork()
    if not child:
        parts.clear()
        on_threads(parts.append, 1000, 2)
        os._exit(0 if len(parts) == 2 else 1)
    _, status = os.waitpid(child, 0)
    assert os.waitstatus_to_exitcode(status) == 0


@pytest.mark.parametrize("task", ["paper_nav-8", "paper_comm-10", "hazard_comm-10", "hazard_nav-8"])
def test_so_many_worlds_that_threads_share_them_go_on_as_alone(task):
    import hipg_bench

    many = hipg_bench.make(task, 300, threads=3)
    one = hipg_bench.make(task, 1, threads=1)
    step, alone = many.reset(), one.reset(np.array([299]))
    rng = np.random.default_rng(0)
    for _ in range(12):
        push = rng.uniform(-1, 1, (many.num_agents, many.action_size))
        step, alone = many.step(np.repeat(push[None], 300, axis=0)), one.step(push[None])
        assert step.observation[299].tobytes() == alone.observation[0].tobytes()
        assert step.reward[299] == alone.reward[0]


@pytest.mark.parametrize("damage", [b"", b"junk", None])
def test_damaged_machine_code_is_made_anew(tmp_path, damage):
    """What Numba keeps on disk is cut, replaced or emptied: the numbers are the same, and it heals."""
    code = (
        "import numpy as np, hipg_bench\nenv = hipg_bench.make('paper_nav-4', 2, threads=1)\n"
        "step = env.reset()\n"
        "for _ in range(3): step = env.step(np.full((2, 4, 2), 0.3))\n"
        "print(step.observation.sum(dtype=float), step.reward.sum())"
    )

    def run():
        done = subprocess.run(
            [sys.executable, "-c", code], env={**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)},
            capture_output=True, text=True, timeout=300, check=False,
        )  # fmt: skip
        assert done.returncode == 0, done.stderr
        return done.stdout

    first = run()
    kept = [path for path in tmp_path.rglob("*") if path.suffix in (".nbi", ".nbc")]
    assert kept
    for path in kept:
        path.write_bytes(path.read_bytes()[:100] if damage is None else damage)
    assert run() == first
    assert run() == first
