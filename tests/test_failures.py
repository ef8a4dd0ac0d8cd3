"""Agents that fail: nothing is dropped, nothing pays, and no row depends on who shared a batch."""

import json

import numpy as np
import pytest

from hipg_bench import make, task_spec
from hipg_bench.errors import AgentFailure
from hipg_bench.evaluation import runner
from hipg_bench.evaluation.episodes import EvaluationJob
from hipg_bench.evaluation.failures import failures_of_a_dnf
from hipg_bench.evaluation.results import summarise
from hipg_bench.policies.bundle import Agent, load_agent
from hipg_bench.policies.simple import Random

SPEC = task_spec("hazard_nav-4").override(horizon=12).model_copy(
    update={"anchors": task_spec("hazard_nav-4").anchors}
)  # fmt: skip


class Faulty:
    """Random actions, but in some episodes something goes wrong at a step."""

    privileged = False

    def __init__(self, fault, episodes, step=5):
        self._random = Random(3)
        self._fault, self._episodes, self._step = fault, episodes, step
        self.opened = self.closed = 0

    def initial_state(self, seed, episode_id, num_agents):
        self.opened += 1
        return self._random.initial_state(seed, episode_id, num_agents), episode_id, 0

    def act(self, seen, memory, alive):
        inner, ids, step = memory
        action, inner = self._random.act(seen, inner, alive)
        bad = np.isin(ids, list(self._episodes))
        if step == self._step and bad.any():
            action = self._fault(action.copy(), bad)
        return action, (inner, ids, step + 1)

    def close(self):
        self.closed += 1


def crash(action, bad):
    raise AgentFailure("crash", "the process ended")


def not_finite(action, bad):
    action[bad, 1, 2] = np.nan
    return action


def wrong_shape(action, bad):
    return action[:, :3]


def not_numbers(action, bad):
    return [[["left"] * 3] * 4] * len(bad)


@pytest.mark.parametrize(
    ("fault", "status"),
    [
        (crash, "crash"),
        (not_finite, "not_finite"),
        (wrong_shape, "wrong_shape"),
        (not_numbers, "wrong_shape"),
    ],
)
def test_only_the_failed_episodes_change_and_count_less(fault, status):
    job = EvaluationJob(episodes=21, threads=1)
    honest = job.play_all(SPEC, Random(3))
    rows = job.play_all(SPEC, Faulty(fault, {0}))
    assert [row["status"] for row in rows] == [status] + 20 * ["ok"]
    for row, good in zip(rows[1:], honest[1:], strict=True):
        assert json.dumps(row) == json.dumps(good)
    # a plain loop: five steps of the policy, then nobody does anything
    env = make(SPEC, 1, 1000, threads=1)
    step, total, alone = env.reset(np.array([0])), 0.0, Random(3)
    memory = alone.initial_state(1000, np.array([0]), 4)
    for t in range(12):
        action, memory = alone.act(step.observation, memory, step.info["alive"])
        step = env.step(action if t < 5 else np.zeros((1, 4, 3)))
        total += step.reward[0]
    assert rows[0]["reached"] == pytest.approx(total, abs=1e-9)
    assert rows[0]["length"] == 12
    # 12 of 50 steps cost less than the anchor's whole episode: the anchor counts
    assert rows[0]["reached"] > SPEC.anchors.random.mean
    assert rows[0]["return"] == SPEC.anchors.random.mean
    assert rows[0]["score"] == pytest.approx(0.0)


def test_a_failure_never_raises_what_was_reached():
    generous = SPEC.model_copy(
        update={
            "anchors": SPEC.anchors.model_copy(
                update={"random": SPEC.anchors.random.model_copy(update={"mean": 1e3})}
            )
        }
    )
    (row,) = EvaluationJob(episodes=1, threads=1).play_all(generous, Faulty(crash, {0}))
    assert row["return"] == row["reached"] < 1e3


@pytest.mark.parametrize("num_envs", [1, 7])
def test_failed_rows_do_not_depend_on_the_batch(num_envs):
    bad = {3, 9}
    expected = EvaluationJob(episodes=40, num_envs=64, threads=1).play_all(SPEC, Faulty(crash, bad))
    rows = EvaluationJob(episodes=40, num_envs=num_envs, threads=1).play_all(SPEC, Faulty(crash, bad))
    assert json.dumps(rows) == json.dumps(expected)
    # 5 % of 40 are 2, so the second failure ends it
    assert [row["world"] for row in rows if row["status"] == "crash"] == [3, 9]
    assert {row["status"] for row in rows[10:]} == {"not_played"}


def test_five_percent_of_failures_are_a_dnf_at_the_floor():
    assert [failures_of_a_dnf(n) for n in (320, 64, 21, 20, 1)] == [16, 4, 2, 1, 1]
    job = EvaluationJob(episodes=24, threads=1)
    for bad, dnf in (({1}, False), ({1, 4}, True)):
        policy = Faulty(crash, bad)
        rows = [row | {"train_seed": 0} for row in job.play_all(SPEC, policy)]
        task = summarise(SPEC, rows)
        assert task["dnf"] is dnf
        assert task["episodes"] == 24
        assert task["failures"] == ({"crash": 2, "not_played": 19} if dnf else {"crash": 1})
        if dnf:
            assert task["return_mean"] == SPEC.floor
            # the batch, worlds 0 to 4 alone, and each with a process of its own
            assert (policy.opened, policy.closed) == (6, 6)
        else:
            assert task["return_mean"] == pytest.approx(np.mean([row["return"] for row in rows]))
            assert task["return_mean"] > SPEC.floor


def test_one_bad_training_does_not_hide_behind_a_good_one():
    job = EvaluationJob(episodes=20, threads=1)
    good = [row | {"train_seed": 0} for row in job.play_all(SPEC, Random(3))]
    bad = [row | {"train_seed": 1} for row in job.play_all(SPEC, Faulty(crash, {5}))]
    task = summarise(SPEC, good + bad)
    mean = np.mean([row["return"] for row in good])
    assert [run["dnf"] for run in task["runs"]] == [False, True]
    assert task["return_mean"] == pytest.approx((mean + SPEC.floor) / 2)


class FaultyAgent(Agent):
    """Random for the runner, but it fails in one episode."""

    def policy(self, spec, train_seed=0):
        return Faulty(crash, {2})


def test_a_longer_evaluation_plays_what_a_dnf_left(tmp_path):
    random = load_agent("random")
    agent, suite = FaultyAgent(random.card, random.folder), runner.Suite("custom", (SPEC,))
    name = f"episodes/{SPEC.task}.jsonl"
    first = runner.evaluate(agent, suite, tmp_path / "a", EvaluationJob(episodes=10, threads=1))
    assert first["tasks"][0]["failures"] == {"crash": 1, "not_played": 7}
    page = (tmp_path / "a/report.html").read_text()
    assert "DNF" in page
    assert "crash 1, not played 7" in page
    again = runner.evaluate(agent, suite, tmp_path / "a", EvaluationJob(episodes=21, threads=1))
    runner.evaluate(agent, suite, tmp_path / "b", EvaluationJob(episodes=21, threads=1))
    assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()
    assert (again["tasks"][0]["failures"], again["tasks"][0]["dnf"]) == ({"crash": 1}, False)
