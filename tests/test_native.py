"""Rules as machine code: what they are linked with, where their code is kept, and what it leans on."""

import math
import os
import subprocess
import sys

import numpy as np
import pytest

import hipg_bench
from hipg_bench import native, records
from hipg_bench.evaluation import machines
from hipg_bench.records import Field


def fill(memory, k, agents, thread, unused):
    pair = pair_at(memory, k)
    pair.total = 0.0
    for i in range(len(pair.part)):
        pair.part[i] = rules.weigh(i)
        pair.total += pair.part[i]
    return len(pair.part)


def tripled(i):
    return 3.0 * doubled(i) / 2.0


def doubled(i):
    return 2.0 * i


@pytest.mark.parametrize("compiler", [native.for_processor, None], ids=["machine code", "Python"])
def test_rules_call_each_other_and_write_records_of_any_size(compiler):
    """Record 1 of two holds 0, 3, 6, ... and their sum."""
    for size in (3, 5):
        kinds = {"pair": (Field("total", np.float64), Field("part", np.float64, ("n",)))}
        types = {"pair": records.dtype(kinds["pair"], {"n": size})}
        memory = native.Memory(kinds, types, compiler)
        pairs = np.zeros(2, types["pair"])
        memory.bind("pair", pairs)
        run = native.link(fill, memory, {"weigh": tripled}, compiler=compiler)
        assert run(native.argument(memory, compiler), 1, 0, 0, 0) == size
        np.testing.assert_array_equal(pairs["part"], [np.zeros(size), 3.0 * np.arange(size)])
        assert pairs["total"].tolist() == [0.0, 3.0 * sum(range(size))]


def test_one_piece_of_machine_code_serves_all_team_sizes(tmp_path):
    """Two team sizes, and two tasks of one family, leave one compiled function on disk."""
    code = (
        "import hipg_bench\n"
        "for n in (3, 5): hipg_bench.make('hazard_nav-4', 1, num_agents=n, threads=1).reset()\n"
        "hipg_bench.make('coop_nav-3', 1, threads=1).reset()"
    )
    subprocess.run(
        [sys.executable, "-c", code], check=True, timeout=200,
        env={**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)},
    )  # fmt: skip
    assert len(list(tmp_path.rglob("*.nbc"))) == 1


COMPILED = {
    "log1p": lambda x: math.log1p(x),
    "exp": lambda x: math.exp(x),
    "sin": lambda x: math.sin(x),
    "cos": lambda x: math.cos(x),
}
"""What rules call of the C library; `sqrt` is rounded correctly everywhere."""
OF_TWO = {"pow", "atan2"}
"""Their second argument is 0.7 in `machines`."""


@pytest.mark.parametrize("name", machines.FUNCTIONS)
def test_the_c_library_is_within_an_ulp_and_machine_code_calls_the_same(name):
    """What `machines` keeps digests of are the functions that they are called after, by mpmath."""
    mpmath, numba = pytest.importorskip("mpmath"), pytest.importorskip("numba")
    function, low, high = machines.FUNCTIONS[name]
    arguments = np.linspace(low, high, 200)
    values = np.array([function(x) for x in arguments])
    with mpmath.workdps(40):
        named, more = getattr(mpmath, "power" if name == "pow" else name), [0.7] * (name in OF_TWO)
        exact = [float(named(mpmath.mpf(float(x)), *more)) for x in arguments]
    assert (np.abs(values - exact) <= np.spacing(np.abs(exact))).all()
    if name in COMPILED:
        compiled = numba.njit(COMPILED[name])
        arguments = np.linspace(low, high, 2000)
        assert [compiled(x) for x in arguments] == [function(x) for x in arguments]


def test_results_are_the_callers_and_their_memory_is_used_again_when_dropped():
    env = hipg_bench.make("hazard_nav-4", 4, threads=1)
    step, action = env.reset(), np.ones((4, 4, 3))
    kept = [(step, step.observation.copy(), step.info["state"].copy(), step.reward.copy())]
    view = step.observation[2, 1]
    told = view.copy()
    for _ in range(10):
        step = env.step(action)
        kept.append((step, step.observation.copy(), step.info["state"].copy(), step.reward.copy()))
    for old, observation, state, reward in kept:
        assert old.observation.tobytes() == observation.tobytes()
        assert old.info["state"].tobytes() == state.tobytes()
        assert old.reward.tobytes() == reward.tobytes()
    kept.clear()
    del old, step
    addresses = set()
    for _ in range(20):
        step = env.step(action)
        addresses.add(step.observation.__array_interface__["data"][0])
        assert view.tobytes() == told.tobytes()  # a view is enough to keep the array
    assert len(addresses) < 6


def test_a_step_allocates_little(monkeypatch):
    """Below 2 MB at 4,096 worlds, once arrays are used again: an observation alone has 11 MB."""
    import tracemalloc

    env = hipg_bench.make("hazard_nav-8", 4096, threads=1)
    monkeypatch.setattr(env._stepper.sim, "advance", lambda: None)  # what MuJoCo needs is not ours
    step, action = env.reset(), np.zeros((4096, 8, 3))
    for _ in range(4):
        step = env.step(action)
    tracemalloc.start()
    step = env.step(action)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert step.reward.shape == (4096,)
    assert peak < 2e6


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork here")
def test_a_forked_child_has_threads_of_its_own():
    env = hipg_bench.make("paper_nav-4", 600, threads=2)
    env.reset()
    env.step(np.zeros((600, 4, 2)))
    child = os.fork()
    if not child:
        env.step(np.zeros((600, 4, 2)))
        os._exit(0)
    _, status = os.waitpid(child, 0)
    assert os.waitstatus_to_exitcode(status) == 0


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
def test_damaged_machine_code_is_compiled_again(tmp_path, damage):
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


def test_a_rule_that_allocates_is_refused():
    """Compiled rules run without memory management: an array that they made would never be freed."""

    def allocates(memory, k, last, thread, unused):
        return len(np.zeros(k))

    kinds = {"pair": (Field("total", np.float64),)}
    memory = native.Memory(kinds, {"pair": records.dtype(kinds["pair"], {})}, native.for_processor)
    with pytest.raises(Exception, match=r"No implementation of function.*zeros"):
        native.link(allocates, memory, {}, compiler=native.for_processor)
