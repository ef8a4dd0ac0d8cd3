"""Blind policies are pure and independent of the batch; bundles are data and are refused with a reason."""

import os
import shutil
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from hipg_bench import make, task_spec
from hipg_bench.errors import BundleError, UnknownNameError
from hipg_bench.paths import data_folder
from hipg_bench.policies.bundle import agents, load_agent
from hipg_bench.policies.network import save_network
from hipg_bench.policies.simple import Constant, Random, TimeOnly, Zero

N, A = 4, 3
BLIND = [Zero(A), Random(A), Constant(A), TimeOnly(A)]


def actions(policy, episodes, steps, seed=5):
    """(B, steps, N, A) of what a policy does that sees nothing of interest."""
    ids = np.array(episodes)
    memory, alive, done = policy.initial_state(seed, ids, N), np.ones((len(ids), N), bool), []
    for _ in range(steps):
        action, memory = policy.act(np.zeros((len(ids), N, 1), np.float32), memory, alive)
        done.append(action)
    return np.stack(done, axis=1)


@pytest.mark.parametrize("policy", BLIND, ids=lambda policy: type(policy).__name__)
def test_actions_do_not_depend_on_the_batch(policy):
    together = actions(policy, [3, 9, 1, 0, 77], 70)
    for place, episode in enumerate([3, 9, 1, 0, 77]):
        np.testing.assert_array_equal(together[place], actions(policy, [episode], 70)[0])


@pytest.mark.parametrize("policy", BLIND, ids=lambda policy: type(policy).__name__)
def test_a_step_leaves_the_memory_as_it_was(policy):
    ids, alive, seen = np.arange(2), np.ones((2, N), bool), np.zeros((2, N, 1), np.float32)
    memory = policy.initial_state(0, ids, N)
    for _ in range(66):
        first, after = policy.act(seen, memory, alive)
        again, _ = policy.act(seen, memory, alive)
        np.testing.assert_array_equal(first, again)
        memory = after


def test_random_is_uniform_and_independent():
    drawn = actions(Random(A), range(20), 130)
    assert stats.kstest(drawn.ravel(), stats.uniform(-1, 2).cdf).pvalue > 1e-3
    # neighbours in time, between agents and between episodes are uncorrelated: |r| < 4 / sqrt(n)
    for one, other in (
        (drawn[:, 1:], drawn[:, :-1]),
        (drawn[:, :, 1:], drawn[:, :, :-1]),
        (drawn[1:], drawn[:-1]),
    ):
        assert abs(np.corrcoef(one.ravel(), other.ravel())[0, 1]) < 4 / np.sqrt(one.size)
    assert not (drawn == actions(Random(A), range(20), 130, seed=6)).any()


def test_open_loops_ignore_the_episode():
    constant = actions(Constant(A), [0, 1], 20)
    assert (constant == constant[:1, :1]).all()
    assert constant.std() > 0
    timed = actions(TimeOnly(A, hold=5), [0, 1], 20)
    np.testing.assert_array_equal(timed[0], timed[1])
    changes = (np.diff(timed[0], axis=0) != 0).any(axis=(1, 2))
    # 20 steps, each action held for 5: it changes after steps 5, 10 and 15
    assert np.flatnonzero(changes).tolist() == [4, 9, 14]


def test_bundled_agents_play():
    assert {"zero", "random", "scripted", "scripted_blind", "mappo_minhealth"} <= set(agents())
    spec = task_spec("hazard_nav-4")
    for name in ("zero", "random", "scripted", "scripted_blind"):
        agent = load_agent(name)
        assert agent.name == name
        assert spec.task in agent.tasks
        policy = agent.policy(spec)
        env = make(spec, 2, threads=1)
        step = env.reset()
        seen = step.info["state"] if policy.privileged else step.observation
        action, _ = policy.act(seen, policy.initial_state(0, np.arange(2), 4), step.info["alive"])
        assert action.shape == (2, 4, 3)
        assert action.dtype == np.float64


def test_unknown_agent_is_told_the_nearest_name():
    with pytest.raises(UnknownNameError, match=r"no agent 'scriptd'; did you mean 'scripted'\?"):
        load_agent("scriptd")


def bundle(folder, text):
    folder.mkdir(exist_ok=True)
    (folder / "agent.toml").write_text(text)
    return folder


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ('name = "x"\nsummary = "s"', "exactly one of 'builtin' and 'kind'"),
        (
            'name = "x"\nsummary = "s"\nbuiltin = "zero"\nkind = "network"',
            "exactly one of 'builtin' and 'kind'",
        ),
        ('name = "x"\nsummary = "s"\nbuiltin = "zerro"', "did you mean 'zero'"),
        ('name = "x"\nsummary = "s"\nbuiltin = "os.system"', "no built-in policy 'os.system'"),
        ('name = "x"\nsummary = "s"\nkind = "pickle"', "kind = 'pickle' is refused"),
        ('name = "x"\nsummary = "s"\nkind = "python"', "kind = 'python' needs 'entry_point', such as"),
        (
            'name = "x"\nsummary = "s"\nkind = "python"\nentry_point = "a:make_agent"',
            "kind = 'python' needs 'tasks', such as [tasks] hazard_nav-4 = [0]",
        ),
        (
            'name = "x"\nsummary = "s"\nkind = "python"\nentry_point = "os.system"',
            "entry_point = 'os.system' is refused",
        ),
        (
            'name = "x"\nsummary = "s"\nkind = "network"\nentry_point = "a:b"',
            "'entry_point' belongs to kind = 'python', got kind = 'network'",
        ),
        (
            'name = "x"\nsummary = "s"\nkind = "python"\nentry_point = "a:b"\ntasks = {t = [1, 1]}',
            "tasks.t = [1, 1]: one or more different seeds",
        ),
        ('name = "x"\nsummary = "s"\nbuiltin = "zero"\nlink = "javascript:x"', "link = 'javascript:x'"),
        (
            'name = "x"\nsummary = "s"\nbuiltin = "zero"\n[training]\nhour = 2',
            "[training]: no field 'hour'; did you mean 'hours'?",
        ),
        ("#" * 70_000, "at most 65536 bytes"),
        ('name = "../x"\nsummary = "s"\nbuiltin = "zero"', "name = '../x' is refused"),
        ('name = "x"\nsumary = "s"\nbuiltin = "zero"', "sum"),
        ("name = ", "agent.toml"),
    ],
)
def test_bad_bundles_are_refused(tmp_path, text, reason):
    with pytest.raises(BundleError) as caught:
        load_agent(bundle(tmp_path / "b", text))
    assert reason in str(caught.value)


def test_a_folder_without_a_card_is_no_bundle(tmp_path):
    with pytest.raises(BundleError, match=r"no agent\.toml"):
        load_agent(tmp_path)


PYTHON = """
name = "coded"
summary = "s"
kind = "python"
entry_point = "team.agent:make_agent"
execution = "centralised"
license = "MIT"
[tasks]
"hazard_nav-4" = [3, 1]
[training]
env_steps = 1000000
framework = "by hand"
"""


def test_a_python_card_names_its_tasks_and_its_files_make_its_fingerprint(tmp_path):
    folder = bundle(tmp_path / "coded", PYTHON)
    (folder / "agent.py").write_text("one")
    agent = load_agent(folder)
    assert (agent.card.tier, agent.card.training.env_steps, agent.card.suite) == (2, 1_000_000, "hipg-1")
    assert agent.tasks == ("hazard_nav-4",)
    assert agent.train_seeds("hazard_nav-4") == (1, 3)
    prints = {agent.fingerprint("hazard_nav-4", seed) for seed in (1, 3)}
    (folder / "agent.py").write_text("two")
    assert agent.fingerprint("hazard_nav-4", 1) not in prints
    assert len(prints) == 2
    with pytest.raises(BundleError, match="no training seed 0 for hazard_nav-4"):
        agent.fingerprint("hazard_nav-4", 0)


def test_a_python_agent_plays_in_its_own_process(tmp_path):
    folder = bundle(tmp_path / "coded", PYTHON.replace("team.agent", "agent"))
    (folder / "agent.py").write_text(
        "import os, numpy as np\n"
        "class Agent:\n"
        "    def __init__(self, task, seed): self.task, self.seed = task, seed\n"
        "    def reset(self, seeds): pass\n"
        "    def act(self, observation, alive):\n"
        "        answer = np.zeros((*alive.shape, self.task['action_size']))\n"
        "        answer[..., 0], answer[..., 1] = self.seed / 8, os.getpid() == PARENT\n"
        "        return answer\n"
        "make_agent = Agent\n".replace("PARENT", str(os.getpid()))
    )
    policy = load_agent(folder).policy(task_spec("hazard_nav-4"), 3)
    seen, alive = np.zeros((2, 4, policy_size("hazard_nav-4")), np.float32), np.ones((2, 4), bool)
    action, _ = policy.act(seen, policy.initial_state(0, np.arange(2), 4), alive)
    assert action[1, 2].tolist() == [0.375, 0.0, 0.0]


def policy_size(task):
    return make(task).layout.observation.size


def weights(o, a, scale=1.0):
    chance = np.random.default_rng(0)
    return {
        "observation.mean": np.zeros(o),
        "observation.scale": np.ones(o),
        "layer0.weight": scale * chance.normal(size=(a, o)),
        "layer0.bias": np.zeros(a),
    }


@pytest.fixture
def network(tmp_path):
    folder = bundle(tmp_path / "net", 'name = "net"\nsummary = "s"\nkind = "network"')
    (folder / "hazard_nav-4").mkdir()
    layout = make("hazard_nav-4").layout
    for seed in (0, 2, 10):
        tensors = weights(layout.observation.size, layout.action.size, 1.0 + seed)
        save_network(tensors, folder / "hazard_nav-4" / f"seed{seed}.safetensors")
    return folder


def test_a_network_bundle_lists_its_tasks_and_training_seeds(network):
    agent = load_agent(network)
    assert agent.tasks == ("hazard_nav-4",)
    assert agent.train_seeds("hazard_nav-4") == (0, 2, 10)
    assert agent.train_seeds("hazard_nav-8") == ()
    assert len({agent.fingerprint("hazard_nav-4", seed) for seed in (0, 2, 10)}) == 3
    assert not agent.policy(task_spec("hazard_nav-4"), 10).privileged


def test_a_network_bundle_says_what_it_has_not(network):
    agent = load_agent(network)
    with pytest.raises(BundleError, match=r"no weights for hazard_nav-8; did you mean 'hazard_nav-4'\?"):
        agent.policy(task_spec("hazard_nav-8"))
    with pytest.raises(BundleError, match=r"no training seed 1 for hazard_nav-4; there are: \(0, 2, 10\)"):
        agent.policy(task_spec("hazard_nav-4"), 1)


def test_weights_for_another_task_do_not_fit(network):
    agent = load_agent(network)
    with pytest.raises(BundleError, match="train again"):
        agent.policy(task_spec("hazard_nav-4").override(num_agents=5))


def test_a_film_takes_the_first_training_whatever_its_seed(tmp_path: Path) -> None:
    """A team of training seed 1 alone: without being told, a film finds it."""
    bundled = data_folder("agents") / "mappo_minhealth"
    (tmp_path / "hazard_nav-8").mkdir()
    shutil.copy(bundled / "agent.toml", tmp_path)
    shutil.copy(bundled / "hazard_nav-8/seed0.safetensors", tmp_path / "hazard_nav-8/seed1.safetensors")
    who, spec = load_agent(str(tmp_path)), task_spec("hazard_nav-8")
    assert who.chosen_policy(spec, None).action_size == 3
    with pytest.raises(BundleError):
        who.chosen_policy(spec, 0)
