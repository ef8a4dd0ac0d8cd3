"""What users of Gymnasium, PettingZoo and NumPy hand over: taken, or refused with what is allowed."""

import copy
import multiprocessing
import pickle

import gymnasium
import jaxtyping
import numpy as np
import pytest
import torch

import hipg_bench
import hipg_bench.gym
from hipg_bench import make, processes
from hipg_bench.adapters.sb3 import HipgVecEnv
from hipg_bench.adapters.torchrl import HipgEnv
from hipg_bench.errors import ActionError, HipgError, SpecError


@pytest.fixture(autouse=True)
def unchecked():
    """As users run it: the tests' own checks of types would refuse first."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)


TASK = "hazard_nav-4"
ID = f"hipg/{TASK}-v1"
SEEDED = {
    "make": lambda seed: make(TASK, seed=seed).reset(),
    "reset": lambda seed: make(TASK).reset(seed=seed),
    "pettingzoo": lambda seed: hipg_bench.parallel_env(TASK).reset(seed=seed),
    "gymnasium": lambda seed: gymnasium.make(ID).reset(seed=seed),
    "vector": lambda seed: gymnasium.make_vec(ID, num_envs=2).reset(seed=seed),
    "dm_control": lambda seed: hipg_bench.load("hazard_nav", "4", task_kwargs={"random": seed}).reset(),
    "torchrl": lambda seed: HipgEnv(TASK).set_seed(seed),
    "sb3": lambda seed: HipgVecEnv(TASK).seed(seed),
}


@pytest.mark.parametrize("way", SEEDED)
@pytest.mark.parametrize("seed", [0, 2**32, 2**64 - 1, np.int64(7), np.uint64(7), None])
def test_seeds_that_are_taken(way, seed):
    SEEDED[way](seed)


@pytest.mark.parametrize("way", SEEDED)
@pytest.mark.parametrize("seed", [-1, 2**64, 2**128, 1.5, "3", float("nan"), np.array([1, 2])])
def test_seeds_that_are_refused(way, seed):
    with pytest.raises(SpecError, match=r"seed = .* is refused: a whole number in 0\.\.18446744073709551615"):
        SEEDED[way](seed)


@pytest.mark.parametrize("name", ["num_envs", "threads"])
@pytest.mark.parametrize("value", [2.0, "2", None, -1, np.array([1, 2])])
def test_counts_that_are_refused(name, value):
    with pytest.raises(SpecError, match=f"{name} = .* is refused: a whole number"):
        make(TASK, **{name: value})


def test_counts_of_numpy_are_taken():
    env = make(TASK, np.int64(3), threads=np.int32(1))
    assert env.reset().observation.shape[0] == 3


def test_episodes_that_a_row_cannot_hold_are_refused():
    env = make(TASK)
    assert env.reset(np.array([2**53 - 1])).info["episode_id"].tolist() == [2**53 - 1]
    for episode in (2**53, -1):
        with pytest.raises(HipgError, match=r"episode ids in 0\.\.2\^53 - 1 are allowed"):
            env.reset(np.array([episode]))
    with pytest.raises(HipgError, match="whole numbers are allowed as episode ids, got float64"):
        env.reset(np.array([1.5]))


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
@pytest.mark.parametrize("change", [{"weights": {"cover": 0}}, {"control_step": 0}, {"sensing_radius": 0}])
def test_numbers_of_a_task_are_finite(change, value):
    (name,) = change
    changed = {name: {next(iter(hipg_bench.task_spec(TASK).weights)): value} if name == "weights" else value}
    with pytest.raises(SpecError, match="is refused"):
        make(TASK, **changed)


BASE = np.full((2, 4, 3), 0.25)


@pytest.mark.parametrize(
    "action",
    [
        BASE.tolist(), torch.tensor(BASE), torch.tensor(BASE, requires_grad=True),
        torch.tensor(BASE, dtype=torch.bfloat16), [torch.tensor(BASE[0]), torch.tensor(BASE[1])],
        BASE.astype(np.float16), np.asfortranarray(BASE), np.broadcast_to(0.25, BASE.shape),
    ],
    ids=str,
)  # fmt: skip
def test_actions_that_are_taken_do_the_same(action, recwarn):
    env, other = make(TASK, 2), make(TASK, 2)
    env.reset()
    other.reset()
    np.testing.assert_array_equal(env.step(action).observation, other.step(BASE).observation)
    assert not recwarn.list


@pytest.mark.parametrize(
    "action",
    [
        None, {}, "abc", BASE.astype(str), BASE.astype(object), BASE + 1j, torch.tensor(BASE + 1j),
        [[[0.0] * 3] * 4, [[0.0] * 3] * 3], np.zeros((2, 4, 3), "datetime64[s]"),
    ],
    ids=str,
)  # fmt: skip
def test_actions_that_are_no_numbers_are_refused(action):
    env = make(TASK, 2)
    env.reset()
    with pytest.raises(ActionError, match="hazard_nav-4: numbers are allowed as actions, got"):
        env.step(action)


def test_a_huge_action_is_clipped_without_a_warning(recwarn):
    env = make(TASK, 2)
    env.reset()
    env.step(np.full((2, 4, 3), 1e308))
    assert not recwarn.list


def starts():
    """Two environments of each kind that nobody seeded, and where they start."""
    yield [gymnasium.make(ID).reset()[0] for _ in range(2)]
    yield [*gymnasium.make_vec(ID, num_envs=2, vectorization_mode="sync").reset()[0]]
    yield [*gymnasium.make_vec(ID, num_envs=2, vectorization_mode="async").reset()[0]]
    yield [gymnasium.make_vec(ID, num_envs=1).reset()[0] for _ in range(2)]
    yield [np.stack([*hipg_bench.parallel_env(TASK).reset()[0].values()]) for _ in range(2)]
    yield [hipg_bench.load("hazard_nav", "4").reset().observation[0]["point_position"] for _ in range(2)]
    yield [HipgEnv(TASK).reset()["agents", "observation"].numpy() for _ in range(2)]
    yield [HipgVecEnv(TASK).reset() for _ in range(2)]


def test_environments_that_nobody_seeded_are_different():
    for first, second in starts():
        assert not np.array_equal(first, second)
    # `make` has the seed 0, as it says
    np.testing.assert_array_equal(make(TASK).reset().observation, make(TASK).reset().observation)


def play(env, steps=3):
    """A few steps that depend on where the environment is."""
    step = None
    for k in range(steps):
        step = env.step(np.full((env.num_envs, env.num_agents, env.action_size), 0.1 * k))
    return step.observation.tobytes() + env.rows.tobytes()


@pytest.mark.parametrize("task", [TASK, "multiwalker-3", "paper_comm-10"])
@pytest.mark.parametrize("how", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])
def test_a_copy_goes_on_where_the_original_was(task, how):
    env = make(task, 3, seed=4, threads=2, autoreset=False, horizon=9)
    fresh = how(env)
    env.reset()
    play(env)
    twin = how(env)
    assert play(twin) == play(env)
    assert twin.reset().info["episode_id"].tolist() == env.reset().info["episode_id"].tolist()
    fresh.reset()
    assert play(fresh) == play(make_reset(task))


def make_reset(task):
    env = make(task, 3, seed=4, autoreset=False, horizon=9)
    env.reset()
    return env


def forked(env, pipe):
    pipe.send(play(env))


@pytest.mark.parametrize("worlds", [1, 8, 512])
@pytest.mark.parametrize("task", [TASK, "multiwalker-3"])
def test_an_environment_works_in_a_forked_process(task, worlds):
    """It steps there as here; a second child only drops it, which must not hang either."""
    env = make(task, worlds, seed=5, threads=2)
    env.reset()
    play(env)
    context = multiprocessing.get_context("fork")
    ear, mouth = context.Pipe(duplex=False)
    children = [
        context.Process(target=forked, args=(env, mouth), daemon=True),
        context.Process(target=len, args=([env],), daemon=True),
    ]
    for child in children:
        child.start()
    assert ear.poll(60)
    there = ear.recv()
    for child in children:
        child.join(20)
        assert child.exitcode == 0
    assert play(env) == there


def test_cores_are_those_that_may_be_used(monkeypatch, tmp_path):
    monkeypatch.setattr(processes.os, "sched_getaffinity", lambda pid: set(range(8)))
    for quota, cores in (("max 100000", 8), ("150000 100000", 2), ("50000 100000", 1), ("", 8), ("junk", 8)):
        monkeypatch.setattr(processes, "_read", lambda path, quota=quota: quota if "cpu.max" in path else "")
        assert processes.usable_cores() == cores


def test_how_long_episodes_are_is_told():
    """Wrappers ask for it; but what ends an episode is the horizon that was asked for."""
    env = gymnasium.make(ID, horizon=70)
    assert env.spec.max_episode_steps == 70
    env.reset()
    ends = [env.step(env.action_space.sample())[3] for _ in range(70)]
    assert ends.index(True) == 69
    assert gymnasium.make(ID).spec.max_episode_steps == hipg_bench.task_spec(TASK).horizon


@pytest.mark.parametrize("task", sorted(hipg_bench.tasks()))
def test_observations_are_within_their_limits(task):
    env = make(task, 4, seed=1)
    low, high = env.layout.observation.limits
    assert np.isfinite(low).any()
    step, chance = env.reset(), np.random.default_rng(0)
    for _ in range(env.spec.horizon):
        step = env.step(chance.uniform(-1, 1, (4, env.num_agents, env.action_size)))
        assert (step.observation >= low).all()
        assert (step.observation <= high).all()
