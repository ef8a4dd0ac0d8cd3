"""BenchMARL: its algorithms, unchanged, on teams that lose members. `make test-benchmarl` runs it."""

import pickle
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("benchmarl")

import torch
from benchmarl.algorithms import algorithm_config_registry
from benchmarl.experiment import Callback, Experiment, ExperimentConfig
from benchmarl.models import MlpConfig
from torchrl.envs import check_env_specs

import hipg_bench
from hipg_bench.adapters.benchmarl import HipgTask, HipgTaskClass
from hipg_bench.errors import SpecError, UnknownNameError

NUMBERS = {"hazard_peak": 0.2, "hazard_radius": 2.0, "horizon": 15}
"""A hazard under which random teams lose members, in short episodes."""
NINE = {
    "mappo": True, "ippo": True, "maddpg": True, "iddpg": True, "masac": True, "isac": True,
    "qmix": False, "vdn": False, "iql": False,
}  # fmt: skip
"""Algorithms of BenchMARL, and whether their actions are continuous."""
EXAMPLES = Path(__file__).parents[2] / "examples"


@pytest.fixture(autouse=True)
def one_thread():
    torch.set_num_threads(1)


class Notes(Callback):
    """What an experiment collected and how its losses went."""

    def __init__(self):
        super().__init__()
        self.batches, self.losses, self.rollouts = [], [], []

    def on_batch_collected(self, batch):
        self.batches.append(batch.clone())

    def on_train_end(self, training_td, group):
        self.losses.append(training_td)

    def on_evaluation_end(self, rollouts):
        self.rollouts.append(rollouts)


def small(folder, **changes):
    """BenchMARL's settings, for two short iterations."""
    config = ExperimentConfig.get_from_yaml()
    values = {
        "save_folder": str(folder), "loggers": [], "max_n_iters": 2, "max_n_frames": None,
        "on_policy_collected_frames_per_batch": 120, "off_policy_collected_frames_per_batch": 120,
        "on_policy_n_envs_per_worker": 4, "off_policy_n_envs_per_worker": 4,
        "on_policy_n_minibatch_iters": 2, "on_policy_minibatch_size": 60,
        "off_policy_n_optimizer_steps": 4, "off_policy_train_batch_size": 32,
        "off_policy_memory_size": 1000, "evaluation_interval": 120, "evaluation_episodes": 2,
    }  # fmt: skip
    for name, value in {**values, **changes}.items():
        setattr(config, name, value)
    return config


def run(algorithm, folder, task="HAZARD_NAV_4", numbers=NUMBERS, **changes):
    """An experiment that has run, what was noted, and the policy's parameters before and after."""
    notes = Notes()
    experiment = Experiment(
        task=HipgTask[task].get_task(config=dict(numbers)),
        algorithm_config=algorithm_config_registry[algorithm].get_from_yaml(),
        model_config=MlpConfig.get_from_yaml(),
        seed=3,
        config=small(folder, **changes),
        callbacks=[notes],
    )
    before = parameters(experiment)
    experiment.run()
    return experiment, notes, before


def parameters(experiment):
    return torch.nn.utils.parameters_to_vector(experiment.policy.parameters()).clone()


def test_these_are_all_algorithms_of_benchmarl():
    assert NINE.keys() == algorithm_config_registry.keys()


@pytest.mark.parametrize("algorithm", NINE)
def test_an_algorithm_runs_unchanged_and_updates(algorithm, tmp_path):
    experiment, notes, before = run(algorithm, tmp_path)
    assert experiment.continuous_actions == NINE[algorithm]
    assert experiment.total_frames == 240
    assert len(notes.losses) == 2
    for losses in notes.losses:
        assert all(torch.isfinite(value).all() for value in losses.values())
    after = parameters(experiment)
    assert torch.isfinite(after).all()
    assert (after != before).any()
    batch = torch.cat(notes.batches, dim=1)
    alive = batch["next", "agents", "alive"]
    assert 0 < alive.float().mean() < 1
    # an episode goes on without those it lost
    assert (~alive.all(dim=-2) & ~batch["next", "done"]).any()
    assert np.isfinite(experiment.mean_return)
    assert list(tmp_path.glob("*/*.json")), "no evaluation was written"


@pytest.mark.parametrize("task", ["MULTIWALKER_3", "HAZARD_COMM_10", "PAPER_NAV_4"])
@pytest.mark.parametrize("algorithm", ["mappo", "qmix"])
def test_other_families(task, algorithm, tmp_path):
    experiment, notes, before = run(algorithm, tmp_path, task, {"horizon": 15}, evaluation=False)
    assert (parameters(experiment) != before).any()
    assert all(torch.isfinite(value).all() for losses in notes.losses for value in losses.values())


def test_algorithms_that_take_both_kinds_of_actions_may_take_the_discrete(tmp_path):
    experiment, notes, _ = run("mappo", tmp_path, prefer_continuous_actions=False)
    assert not experiment.continuous_actions
    assert notes.batches[0]["agents", "action"].dtype == torch.int64


def test_returns_are_the_teams_whoever_died(tmp_path):
    """BenchMARL's figure, against the same actions in worlds without it."""
    _, notes, _ = run("mappo", tmp_path)
    batch = torch.cat(notes.batches, dim=1)
    env = hipg_bench.make("hazard_nav-4", 4, 3, autoreset=False, **NUMBERS)
    env.reset()
    compared = 0
    for t in range(batch.shape[1]):
        step = env.step(batch["agents", "action"][:, t].numpy())
        done = step.terminated | step.truncated
        np.testing.assert_array_equal(batch["next", "done"][:, t, 0], done)
        if done.any():
            reported = batch["next", "agents", "episode_reward"][done, t].mean(dim=(-1, -2))
            np.testing.assert_allclose(reported, step.info["metrics"]["return"][done], rtol=1e-5)
            compared += int((step.info["metrics"]["deaths"][done] > 0).sum())
            env.reset(worlds=np.flatnonzero(done))
    assert compared > 2


def test_evaluation_runs_whole_episodes(tmp_path):
    _, notes, _ = run("mappo", tmp_path)
    lengths = [len(rollout) for rollouts in notes.rollouts for rollout in rollouts]
    assert set(lengths) == {NUMBERS["horizon"]}


def test_discrete_choices_are_rest_and_pushes_along_one_axis():
    task = HipgTask.HAZARD_NAV_4.get_task(config={"bins": 3})
    env = task.get_env_fun(num_envs=2, continuous_actions=False, seed=0, device="cpu")()
    actions = task.action_spec(env)["agents", "action"]
    assert actions.space.n == 10
    assert actions.shape == (4,)
    expected = [
        [0, 0, 0],
        [-1, 0, 0], [0, 0, 0], [1, 0, 0],
        [0, -1, 0], [0, 0, 0], [0, 1, 0],
        [0, 0, -1], [0, 0, 0], [0, 0, 1],
    ]  # fmt: skip
    twin = hipg_bench.make("hazard_nav-4", 2, 0)
    shown = env.reset()
    twin.reset()
    for choices in torch.arange(20).reshape(5, 4):
        shown["agents", "action"] = (torch.stack([choices, choices + 3])) % 10
        step = twin.step(np.array(expected, float)[shown["agents", "action"].numpy()])
        shown = env.step(shown)["next"].exclude(("agents", "reward"))
        np.testing.assert_array_equal(shown["agents", "observation"], step.observation)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("continuous", [True, False])
@pytest.mark.parametrize("task", HipgTask)
def test_torchrl_is_content_with_every_task(task, continuous):
    task = task.get_task()
    env = task.get_env_fun(num_envs=2, continuous_actions=continuous, seed=0, device="cpu")()
    check_env_specs(env)
    assert task.max_steps(env) == task.spec.horizon
    assert list(task.observation_spec(env).keys(True, True)) == [("agents", "observation")]
    assert list(task.state_spec(env).keys(True, True)) == ["state"]
    assert task.group_map(env) == env.group_map


def test_every_task_has_a_member():
    specs = [task.get_task().spec.task for task in HipgTask]
    assert specs == list(hipg_bench.tasks())
    assert HipgTask.HAZARD_NAV_4.get_task().spec.task == "hazard_nav-4"
    assert HipgTask.env_name() == "hipg"


def test_numbers_come_from_a_dict_or_from_yaml(tmp_path):
    assert HipgTask.HAZARD_NAV_4.get_task().spec.horizon == hipg_bench.task_spec("hazard_nav-4").horizon
    assert HipgTask.HAZARD_NAV_4.get_from_yaml() == HipgTask.HAZARD_NAV_4.get_task()
    path = tmp_path / "short.yaml"
    path.write_text("horizon: 7\nbins: 4\nweights: {distance: -2.0}\n", encoding="utf-8")
    task = HipgTask.HAZARD_NAV_4.get_from_yaml(str(path))
    assert task.spec.horizon == 7
    assert task.spec.weights["distance"] == -2.0
    assert task.config["bins"] == 4
    same = HipgTask.HAZARD_NAV_4.get_task(config={"horizon": 7, "bins": 4, "weights": {"distance": -2.0}})
    assert task == same


def test_a_wrong_config_is_explained():
    with pytest.raises(SpecError, match="did you mean 'horizon'"):
        HipgTask.HAZARD_NAV_4.get_task(config={"horizn": 5})
    with pytest.raises(SpecError, match=r"hazard_nav-4: bins >= 2 .* got 1"):
        HipgTask.HAZARD_NAV_4.get_task(config={"bins": 1})
    with pytest.raises(UnknownNameError, match="hazard_nav-4"):
        HipgTaskClass("hazard_nav4")


def test_a_checkpoint_goes_on_where_it_was(tmp_path):
    experiment, _, _ = run("qmix", tmp_path, evaluation=False, checkpoint_at_end=True)
    saved = next(tmp_path.glob("*/checkpoints/*.pt"))
    again = Experiment.reload_from_file(str(saved), {"max_n_iters": 3})
    assert again.task == experiment.task
    torch.testing.assert_close(parameters(again), parameters(experiment))
    again.run()
    assert again.total_frames == 360
    assert pickle.loads(pickle.dumps(HipgTask.HAZARD_NAV_4)) is HipgTask.HAZARD_NAV_4


@pytest.mark.parametrize("example", ["benchmarl_maddpg.py", "benchmarl_qmix.py"])
def test_an_example_runs(example, tmp_path):
    done = subprocess.run(
        [sys.executable, EXAMPLES / example, "--frames", "4000", "--folder", tmp_path],
        capture_output=True, text=True, timeout=200,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert re.search(r"^mean return -\d+\.\d+$", done.stdout, re.MULTILINE)
    assert list(tmp_path.iterdir())
