"""Agents of others: what they are told, what they may answer, and how they fail."""

import itertools
import json
import time

import numpy as np
import pytest
from foreign import SEEN, TASK, WORKING, A, N, acting, policy, step

from hipg_bench import registry
from hipg_bench.errors import AgentFailure, HostFailure, SandboxError
from hipg_bench.evaluation.episodes import EvaluationJob
from hipg_bench.policies.foreign import agent_seeds
from hipg_bench.policies.policy import Policy
from hipg_bench.sandbox import choice
from hipg_bench.sandbox.backend import Start
from hipg_bench.sandbox.budget import Budget

pytestmark = pytest.mark.skipif(not WORKING, reason="no sandbox works on this machine")
ZEROS = f"return np.zeros((*alive.shape, {A}))"
LINEAR = """
import numpy as np

class Agent:
    def __init__(self, size, actions):
        self.weight = np.random.default_rng(7).normal(0, 0.3, (size, actions))

    def reset(self, seeds):
        pass

    def act(self, observation, alive):
        return np.tanh(observation @ self.weight)

def make_agent(task, train_seed):
    return Agent(task["observation_size"], task["action_size"])
"""


class _Linear:
    """The same agent in this process."""

    privileged = False

    def __init__(self):
        self._weight = np.random.default_rng(7).normal(0, 0.3, (SEEN, A))

    def initial_state(self, seed, episode_id, num_agents):
        return None

    def act(self, observation, memory, alive):
        return np.round(np.tanh(observation @ self._weight) * 2**16) / 2**16, memory


def test_episodes_are_the_same_in_the_sandbox_in_a_plain_child_and_in_this_process(tmp_path):
    short = TASK.override(horizon=40)
    job = EvaluationJob(episodes=3, threads=1)
    here = job.play_all(short, _Linear())
    for trust in (False, True):
        agent = policy(tmp_path, LINEAR, spec=short, trust=trust)
        assert isinstance(agent, Policy)
        assert agent.sandbox == ("none" if trust else WORKING[0])
        assert job.play_all(short, agent) == here
    one_by_one = EvaluationJob(episodes=3, num_envs=1, threads=1)
    assert one_by_one.play_all(short, policy(tmp_path, LINEAR, spec=short)) == here


def test_the_agent_is_told_the_task_and_its_training_seed_and_nothing_of_the_worlds(tmp_path, monkeypatch):
    monkeypatch.setenv("HIPG_SALT", "secret")
    source = """
    import json, os
    def make_agent(task, train_seed):
        print(json.dumps([task, train_seed, dict(os.environ)]))
        return Agent()
    class Agent:
        def reset(self, seeds):
            print(json.dumps([seeds.tolist(), str(seeds.dtype)]))
        def act(self, observation, alive):
            print(json.dumps([observation.shape, str(observation.dtype), alive.shape, str(alive.dtype)]))
            return observation[..., :%d] * 0
    """
    _, session = step(policy(tmp_path, source % A, train_seed=3), worlds=2, seed=1000)
    session.child.ask({"do": "act", "shape": [0, N, SEEN]}, [], 2.0)  # whatever it printed has come by now
    told, began, saw, _ = (json.loads(line) for line in bytes(session.child.words).decode().splitlines())
    task, train_seed, environment = told
    assert train_seed == 3
    layout = registry.definition_of(TASK).layout
    assert {key: task[key] for key in ("name", "num_agents", "observation_size", "action_size")} == {
        "name": "hazard_nav-4", "num_agents": 4, "observation_size": SEEN, "action_size": A,
    }  # fmt: skip
    assert (task["horizon"], task["control_step"]) == (TASK.horizon, TASK.control_step)
    assert [block["name"] for block in task["observation"]] == list(layout.observation.slices)
    assert sum(int(np.prod(block["shape"])) for block in task["action"]) == A
    assert set(task) == {"name", "num_agents", "observation_size", "action_size", "horizon", "control_step",
                         "observation", "action"}  # fmt: skip
    assert not any(name.startswith("HIPG") or "secret" in value for name, value in environment.items())
    assert environment["OMP_NUM_THREADS"] == "1"
    assert environment["HOME"] == "/tmp"
    assert began == [agent_seeds(1000, np.arange(2)).tolist(), "int64"]
    assert saw == [[2, N, SEEN], "float32", [2, N], "bool"]


def test_seeds_for_agents_belong_to_a_world_not_to_a_batch_and_tell_nothing_of_it():
    seeds = agent_seeds(1000, np.arange(64))
    assert len(set(seeds.tolist())) == 64
    assert agent_seeds(1000, np.array([17, 5])).tolist() == [seeds[17], seeds[5]]
    assert not set(seeds.tolist()) & set(agent_seeds(1001, np.arange(64)).tolist())
    assert seeds.min() > 10**12  # of 64 numbers of 63 bits, none is near a seed or an index
    # half of 63 bits differ between neighbours; the mean of 63 counts deviates by 0.5, we allow five of that
    flips = [(a ^ b).bit_count() for a, b in itertools.pairwise(seeds.tolist())]
    assert abs(np.mean(flips) - 31.5) < 2.5


def test_actions_are_rounded_to_the_grid_of_declared_networks(tmp_path):
    action, _ = step(policy(tmp_path, acting(f"return np.full((*alive.shape, {A}), 0.1)")))
    assert action.dtype == np.float64
    assert (action == 6554 / 65536).all()  # 0.1 * 65536 = 6553.6


def test_what_is_answered_for_the_dead_is_ignored(tmp_path):
    alive = np.array([[True, False, True, False]])
    agent = policy(tmp_path, acting(f"return np.where(alive[..., None], 0.5, np.nan) * np.ones({A})"))
    action, _ = step(agent, worlds=1, alive=alive)
    assert (action[0, [0, 2]] == 0.5).all()
    assert (action[0, [1, 3]] == 0.0).all()


def test_an_agent_may_keep_and_write_to_what_it_was_given(tmp_path):
    body = f"""
    if self.calls == 1:
        self.first, self.copy = observation, observation.copy()
    same = (self.first == self.copy).all()
    observation[:] = np.arange(observation.size).reshape(observation.shape) if self.calls > 1 else observation
    alive[:] = False
    return np.full((*alive.shape, {A}), float(same))
    """
    action, _ = step(policy(tmp_path, acting(body)), steps=3)
    assert (action == 1.0).all()


FAILURES = {
    "raises": ("1 / 0", "crash", "ZeroDivisionError"),
    "exits": ("sys.exit(0)", "crash", "SystemExit"),
    "ends its process": ("os._exit(3)", "crash", "status 3"),
    "is null": ("return None", "wrong_shape", "NoneType"),
    "is a number": ("return 0.5", "wrong_shape", r"\[2, 4, 3\].*float"),
    "is a word": ("return 'left'", "wrong_shape", "str"),
    "is ragged": ("return [[1.0], [1.0, 2.0]]", "wrong_shape", "list"),
    "has another shape": (f"return np.zeros((1, {N}, {A}))", "wrong_shape", r"\[1, 4, 3\]"),
    "is huge": ("return np.zeros(10**6)", "wrong_shape", "8000000 bytes"),
    "is NaN": (f"return np.full((*alive.shape, {A}), np.nan)", "not_finite", "agent 0"),
    "is infinite": (f"return np.full((*alive.shape, {A}), -np.inf)", "not_finite", "-inf"),
    "writes to every pipe": ("[os.write(fd, b'x' * 99) for fd in range(9) if fd != 2 and _open(fd)]\n"
                             f"return np.zeros((*alive.shape, {A}))", "crash|wrong_shape", "answer"),
}  # fmt: skip


@pytest.mark.parametrize("name", FAILURES)
def test_an_answer_that_is_no_action_is_a_failure_with_a_reason(tmp_path, name):
    body, status, reason = FAILURES[name]
    source = acting(body) + (
        "\ndef _open(fd):\n    try:\n        return os.write(fd, b'') == 0\n"
        "    except OSError:\n        return False\n"
    )
    agent = policy(tmp_path, source)
    with pytest.raises(AgentFailure, match=reason) as failed:
        step(agent)
    assert failed.value.status in status.split("|")


def test_an_agent_that_cannot_be_made_says_why(tmp_path):
    for source, reason in (
        ("import no_such_module", "No module named 'no_such_module'"),
        ("def other(): ...", "no attribute 'make_agent'"),
        ("print('half way')\nmake_agent = lambda task, seed: task['colour']", "half way"),
        ("def make_agent(task, seed): return (", "SyntaxError"),
        (f"open({str(tmp_path / 'x')!r}, 'w')", "OSError|FileNotFoundError|PermissionError"),
    ):
        with pytest.raises(AgentFailure, match=reason) as failed:
            step(policy(tmp_path, source))
        assert failed.value.status == "crash"
    assert not (tmp_path / "x").exists()


def test_clocks_are_the_parents(tmp_path):
    slow = acting(f"time.sleep(0.15)\n{ZEROS}")
    # alone, each step is 0.05 s over: a bank of 0.2 s lasts for four steps at most
    strict = Budget(soft=0.1, bank=0.2, hard=5.0)
    step(policy(tmp_path, slow, budget=strict), worlds=1, steps=2)
    with pytest.raises(AgentFailure, match="beyond that") as failed:
        step(policy(tmp_path, slow, budget=strict), worlds=1, steps=5)
    assert failed.value.status == "timeout"
    # two worlds may take 0.2 s together
    step(policy(tmp_path, slow, budget=strict), worlds=2, steps=5)
    for body, budget, most in (
        ("time.sleep(100)", Budget(soft=0.1, hard=0.4), 0.4),
        ("while True: pass", Budget(soft=0.1, hard=0.4), 0.4),
        ("while True: sys.stdout.write('x' * 1000)", Budget(soft=0.1, hard=0.4), 0.4),
    ):
        agent = policy(tmp_path, acting(body), budget=budget)
        session = agent.initial_state(5, np.arange(1), N)
        started = time.monotonic()
        with pytest.raises(AgentFailure, match="in time") as failed:
            agent.act(np.zeros((1, N, SEEN), np.float32), session, np.ones((1, N), bool))
        assert failed.value.status == "timeout"
        assert most <= time.monotonic() - started < most + 1.0
        assert len(session.child.words) <= 64 << 10
    with pytest.raises(AgentFailure, match="in time"):
        step(policy(tmp_path, "import time; time.sleep(100)", budget=Budget(start_up=1.0)))


def test_of_a_flood_of_words_the_last_are_kept(tmp_path):
    body = "print('word ' * 100_000)\nraise ValueError('the reason')"
    with pytest.raises(
        AgentFailure, match=r"(?s)ValueError: the reason.*word word.*ValueError: the reason"
    ) as failed:
        step(policy(tmp_path, acting(body)))
    assert len(str(failed.value)) < 4000


def test_a_batch_may_take_what_its_worlds_may_take_one_by_one():
    budget = Budget()
    assert budget.deadline(1) == pytest.approx(2.0)
    assert budget.deadline(64) == pytest.approx(8.3)  # 64 x 0.1 s, and 1.9 s beyond
    assert budget.overtime(64, 6.0) == 0.0
    assert budget.overtime(64, 7.0) == pytest.approx(0.6)
    assert budget.overtime(1, 0.35) == pytest.approx(0.25)


def test_memory_beyond_the_limit_is_refused(tmp_path):
    hog = acting(f"np.ones(3 << 30, np.uint8)\n{ZEROS}")
    with pytest.raises(AgentFailure, match="MemoryError"):
        step(policy(tmp_path, hog))
    small = acting(f"np.ones(1 << 26, np.uint8)\n{ZEROS}")
    step(policy(tmp_path, small))


def test_a_sandbox_that_fails_to_start_is_tried_once_more_and_costs_the_agent_nothing(tmp_path, monkeypatch):
    good = choice.BACKENDS[WORKING[0]]
    starts = []

    def bad_at_first(folder):
        starts.append(folder)
        return Start(["/no/such/program"], {}) if len(starts) <= bad else good(folder)

    agent, other = policy(tmp_path, LINEAR), policy(tmp_path, LINEAR)
    monkeypatch.setattr(choice, "BACKENDS", {agent.sandbox: bad_at_first})
    bad = 1
    step(agent)
    assert len(starts) == 3  # a failure, the child that plays, the one that waits
    bad = 100
    starts.clear()
    with pytest.raises(HostFailure, match="/no/such/program"):
        step(other)
    assert len(starts) == 2


def test_without_a_sandbox_code_of_others_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(choice, "BACKENDS", {"none": choice.BACKENDS["none"]})
    with pytest.raises(SandboxError, match=r"--trust.*never verified"):
        policy(tmp_path, LINEAR)
    assert policy(tmp_path, LINEAR, trust=True).sandbox == "none"
