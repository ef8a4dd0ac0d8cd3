"""Saved episodes are those that evaluation plays, and can be replayed from their actions."""

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from hipg_bench import make, task_spec
from hipg_bench.cli import app
from hipg_bench.errors import HipgError
from hipg_bench.evaluation.episodes import EvaluationJob
from hipg_bench.evaluation.trajectories import check_target, read_npz, trajectories, write
from hipg_bench.policies.bundle import load_agent


@pytest.fixture(scope="module", params=["multiwalker-3", "hazard_nav-4"])
def played(request):
    spec = task_spec(request.param)
    job = EvaluationJob(seed=3, episodes=5, num_envs=3, threads=1)
    policy = load_agent("random").policy(spec)
    return spec, job, list(trajectories(spec, policy, job))


def test_returns_and_lengths_are_those_of_an_evaluation(played):
    spec, job, found = played
    rows = job.play_all(spec, load_agent("random").policy(spec))
    assert [(one.seed, one.episode_id) for one in found] == [(3, k) for k in range(5)]
    for one, row in zip(found, rows, strict=True):
        assert len(one.reward) == len(one.action) == row["length"]
        assert len(one.observation) == len(one.state) == len(one.health) == row["length"] + 1
        assert one.reward.sum() == pytest.approx(row["return"], rel=1e-12)
        assert one.end_reason == row["end_reason"]
        assert one.terminated == (row["end_reason"] != "horizon")
        assert (one.alive == (one.health > 0)).all()
        assert int((~one.alive[-1]).sum()) == row["deaths"]


def test_actions_replay_the_episode(played):
    spec, _, found = played
    for one in found[:2]:
        env = make(spec, 1, one.seed, threads=1, autoreset=False)
        step = env.reset(np.array([one.episode_id]))
        for t, action in enumerate(one.action):
            np.testing.assert_array_equal(step.observation[0], one.observation[t])
            np.testing.assert_array_equal(step.info["state"][0], one.state[t])
            step = env.step(action[None])
            assert step.reward[0] == one.reward[t]
        np.testing.assert_array_equal(step.info["final_observation"][0], one.observation[-1])


def test_npz_gives_back_what_was_written(played, tmp_path):
    spec, _, found = played
    path = str(tmp_path / "data.npz")
    write(path, spec, "random", found)
    again_spec, again = read_npz(Path(path))
    assert again_spec == spec
    for one, other in zip(found, again, strict=True):
        for name, value in vars(one).items():
            np.testing.assert_array_equal(value, getattr(other, name), err_msg=name)
    with pytest.raises(HipgError, match="exists"):
        check_target(path)


def test_minari_gives_back_what_was_written(played, tmp_path, monkeypatch):
    minari = pytest.importorskip("minari")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    spec, _, found = played
    name = f"hipg/{spec.task}/random-v0"
    write(name, spec, "random", found)
    data = minari.load_dataset(name)
    assert (data.total_episodes, data.total_steps) == (5, sum(len(one.reward) for one in found))
    for one, episode in zip(found, data.iterate_episodes(), strict=True):
        np.testing.assert_array_equal(episode.observations, one.observation)
        np.testing.assert_array_equal(episode.actions, one.action)
        np.testing.assert_allclose(episode.rewards, one.reward)
        np.testing.assert_array_equal(episode.infos["alive"], one.alive)
        np.testing.assert_array_equal(episode.infos["state"], one.state)
        assert episode.terminations[-1] == one.terminated
        assert episode.truncations[-1] != one.terminated
        assert not episode.terminations[:-1].any()
    with pytest.raises(HipgError, match="already"):
        check_target(name)


@pytest.mark.parametrize("out", ["data.csv", "data", "../x-v0.pkl", "a b-v1"])
def test_other_targets_are_refused_before_playing(out):
    with pytest.raises(HipgError, match=r"ends in \.npz"):
        check_target(out)


def test_what_is_no_data_set_is_told(tmp_path):
    for k, content in enumerate((b"", b"nothing", b"PK\x03\x04")):
        path = tmp_path / f"{k}.npz"
        path.write_bytes(content)
        with pytest.raises(HipgError):
            read_npz(Path(path))
    np.savez(tmp_path / "other.npz", x=np.arange(3))
    with pytest.raises(HipgError, match="holds no episodes"):
        read_npz(tmp_path / "other.npz")


def test_the_command(tmp_path):
    path = tmp_path / "data.npz"
    done = CliRunner().invoke(
        app,
        ["rollout", "--agent", "scripted", "--task", "coop_nav-3", "--episodes", "2", "--out", str(path)],
        catch_exceptions=False,
    )
    assert done.exit_code == 0
    assert "2 episodes" in done.output
    spec, found = read_npz(Path(path))
    assert (spec.task, len(found)) == ("coop_nav-3", 2)
    with np.load(path) as file:
        assert json.loads(str(file["spec"]))["task"] == "coop_nav-3"
