"""Splits: the physics is really another one, the dead really die, strangers really steer, films replay."""

import json

import mujoco
import numpy as np
import pytest

from hipg_bench import make, task_spec
from hipg_bench.errors import BundleError, UnknownNameError
from hipg_bench.evaluation import films, splits
from hipg_bench.evaluation.episodes import EvaluationJob
from hipg_bench.policies.bundle import load_agent
from hipg_bench.policies.scripted import Scripted
from hipg_bench.policies.simple import Random, Zero
from hipg_bench.registry import tagged

NAV = task_spec("hazard_nav-4")
SHIFTED = splits.SPLITS[1:]


@pytest.mark.parametrize("split", SHIFTED)
@pytest.mark.parametrize("task", ["hazard_nav-4", "multiwalker-3"])
def test_rows_do_not_depend_on_the_batch_and_episodes_replay(task, split):
    spec, policy = NAV, Scripted(NAV, blind=True)
    if task == "multiwalker-3":
        spec = task_spec(task).override(horizon=60)
        policy = load_agent("mappo_minhealth").policy(spec)
    whole = EvaluationJob(episodes=4, threads=1, split=split)
    rows = whole.play_all(spec, policy)
    parts = EvaluationJob(episodes=4, num_envs=3, threads=2, split=split).play_all(spec, policy)
    assert json.dumps(rows) == json.dumps(parts)
    states = whole.record(spec, policy, rows[3])
    assert len(states) == rows[3]["length"] + 1


def test_worlds_are_those_of_the_standard_split():
    """The same start and the same random numbers, so that splits can be compared world by world."""
    starts = {}
    for split in ("standard", "forced_death", "ad_hoc"):
        job = EvaluationJob(episodes=1, threads=1, split=split)
        (row,) = job.play_all(NAV, Zero(3))
        starts[split] = job.record(NAV, Zero(3), row)[0]
    assert (starts["standard"] == starts["forced_death"]).all()
    assert (starts["standard"] == starts["ad_hoc"]).all()


def test_forced_deaths_are_what_a_plain_loop_over_one_world_does():
    """Each death read from the row, brought about by hand at its time; everything else must follow."""
    job = EvaluationJob(episodes=3, threads=1, split="forced_death")
    policy = Scripted(NAV, blind=True)
    for row in job.play_all(NAV, policy):
        forced = {round(d["time"] / 0.1): d["agent"] for d in row["death_list"] if d["cause"] == "forced"}
        assert len(forced) == 1
        assert 5 <= min(forced) <= 25
        env = make(NAV, 1, 1000, threads=1)
        step, total, own = env.reset(np.array([row["episode_id"]])), 0.0, []
        for t in range(1, 51):
            action, _ = policy.act(step.info["state"], None, step.info["alive"])
            before = step.info["alive"][0]
            step = env.step(action)
            total += step.reward[0]
            own += np.flatnonzero(before & ~step.info["final_alive"][0]).tolist()
            if t in forced:
                assert step.info["alive"][0, forced[t]]
                step = env.load_rows(np.array([0]), env.fork(env.rows, {forced[t]: 0.0}))
                assert not step.observation[0, forced[t]].any()
        assert row["reached"] == pytest.approx(total, abs=1e-9)
        # the split's victims are not held against the team
        assert row["deaths"] == len(own)
        assert row["survival"] == pytest.approx(1 - len(own) / 3)


def test_who_is_killed_and_when_is_drawn_evenly():
    split_config = splits.split_config("forced_death", task_spec("hazard_nav-8"))
    schedule = split_config.death_schedule(7, np.arange(3000), task_spec("hazard_nav-8"))
    victims = schedule >= 0
    # a quarter of eight; 3000 draws of 2 in 8: 750 each, deviation sqrt(3000 * 3 / 16) = 24
    assert (victims.sum(axis=1) == 2).all()
    assert np.abs(victims.sum(axis=0) - 750).max() < 5 * 24
    # from a tenth to a half of 50 steps, 21 values: 6000 / 21 = 286 each, deviation 17
    times = np.bincount(schedule[victims], minlength=51)
    assert set(np.flatnonzero(times)) == set(range(5, 26))
    assert np.abs(times[5:26] - 286).max() < 5 * 17
    assert (split_config.death_schedule(8, np.arange(9), task_spec("hazard_nav-8")) != schedule[:9]).any()
    # small teams lose one
    assert (split_config.death_schedule(7, np.arange(50), task_spec("coop_nav-3")) >= 0).sum(
        axis=1
    ).tolist() == 50 * [1]


def test_a_death_beyond_the_end_does_not_happen():
    """Random walkers drop the plank before half of the horizon: nobody dies after that."""
    rows = EvaluationJob(episodes=12, threads=1, split="forced_death").play_all(
        task_spec("multiwalker-3"), Random(6)
    )
    times = [d["time"] for row in rows for d in row["death_list"] if d["cause"] == "forced"]
    assert len(times) < 12
    for row in rows:
        assert all(d["time"] < row["length"] * 0.02 for d in row["death_list"] if d["cause"] == "forced")
        # what the family counts as its own causes leaves them out
        assert row["metrics"]["tipped"] + row["metrics"]["sunk"] == row["deaths"]


def test_strangers_steer_their_bodies_and_the_agent_the_rest():
    (row,) = EvaluationJob(episodes=1, threads=1, split="ad_hoc").play_all(NAV, Random(3))
    assert len(row["others"]) == 2
    env, random, blind = make(NAV, 1, 1000, threads=1), Random(3), Scripted(NAV, blind=True)
    step, total = env.reset(np.array([0])), 0.0
    memory = random.initial_state(1000, np.array([0]), 4)
    for _ in range(50):
        mine, memory = random.act(step.observation, memory, step.info["alive"])
        theirs, _ = blind.act(step.info["state"], None, step.info["alive"])
        for i in row["others"]:
            mine[0, i] = theirs[0, i]
        step = env.step(mine)
        total += step.reward[0]
    assert row["reached"] == pytest.approx(total, abs=1e-9)
    # their deaths are listed, but are not the agent's
    own = [d for d in row["death_list"] if d["agent"] not in row["others"]]
    assert (row["deaths"], row["survival"]) == (len(own), 1 - len(own) / 2)


def test_bodies_of_strangers_are_drawn_evenly():
    split_config = splits.split_config("ad_hoc", NAV)
    theirs = split_config.bodies_of_others(7, np.arange(3000), 5)
    # two of five: 1200 each, deviation sqrt(3000 * 6 / 25) = 27
    assert (theirs.sum(axis=1) == 2).all()
    assert np.abs(theirs.sum(axis=0) - 1200).max() < 5 * 27


def test_shifts_are_dealt_to_the_evaluation_seeds():
    job = EvaluationJob(episodes=320, split="shift")
    split_config = splits.split_config("shift", NAV)
    assert [split_config.variant(block) for block in range(6)] == [0, 1, 2, 3, 4, 0]
    told = [job.spec(NAV, world).params for world in (0, 64, 128, 192, 256, 319)]
    for k, params in enumerate([*told[:5], told[4]][:5]):
        changed = {name for name, value in params.items() if value != NAV.params[name]}
        assert changed == set(split_config.shifts[k].params)
        assert changed
    assert told[5] == told[4]
    assert job.spec(NAV, 70).anchors == NAV.anchors


def test_shifted_walkers_have_another_model():
    spec = task_spec("multiwalker-3")
    split_config = splits.split_config("shift", spec)
    plain = make(spec, 1, threads=1).model
    foot = mujoco.mj_name2id(plain, mujoco.mjtObj.mjOBJ_GEOM, "walker1/left_foot")
    plank = mujoco.mj_name2id(plain, mujoco.mjtObj.mjOBJ_BODY, "plank/plank")
    for block, (friction, strength, mass) in enumerate(
        [(1, 1, 1.5), (1, 1, 0.5), (0.6, 1, 1), (1, 0.85, 1), (0.75, 0.9, 1.3)]
    ):
        env = split_config.make(spec, block, 1, 0, 1)
        model = env.model
        # contact friction is the larger one of two geoms: all must change
        np.testing.assert_allclose(model.geom_friction[:, 0], friction * plain.geom_friction[:, 0])
        np.testing.assert_allclose(model.actuator_forcerange, strength * plain.actuator_forcerange)
        assert model.geom_friction[foot, 0] == pytest.approx(friction)
        # three walkers; the plank's rails and ridges weigh the same as ever
        assert model.body_mass[plank] - plain.body_mass[plank] == pytest.approx(3 * (mass - 1))
        assert env.rows.shape == make(spec, 1, threads=1).rows.shape


def test_shifted_physics_moves_otherwise():
    spec = task_spec("multiwalker-3")
    split_config = splits.split_config("shift", spec)
    heights = []
    for block in (None, 0, 2, 3):
        env = make(spec, 1, 5, threads=1) if block is None else split_config.make(spec, block, 1, 5, 1)
        step, random = env.reset(np.array([0])), Random(6)
        memory = random.initial_state(5, np.array([0]), 3)
        for _ in range(15):
            action, memory = random.act(step.observation, memory, step.info["alive"])
            step = env.step(action)
        heights.append(float(step.info["state"].sum()))
    assert len(set(heights)) == 4


def test_films_show_the_shifted_task(tmp_path):
    agent, job = load_agent("random"), EvaluationJob(episodes=66, threads=1, split="shift")
    short = NAV.override(horizon=5)
    rows = [row | {"train_seed": 0} for row in job.play_all(short, agent.policy(short))]
    (film,) = films.choose(agent, short, rows[64:], job, 1, tmp_path)
    assert film.spec.params["thrust"] == 8.0
    assert json.loads(str(np.load(film.saved)["spec"]))["params"]["thrust"] == 8.0


@pytest.mark.parametrize("split", SHIFTED)
@pytest.mark.parametrize("task", tagged("standard"))
def test_every_standard_task_has_anchors_in_every_split(task, split):
    anchors = splits.with_anchors(split, task_spec(task)).anchors
    assert anchors is not None
    assert anchors.random.episodes >= 1000
    assert anchors.reference.episodes >= 1000 or "stated" in anchors.reference_is
    # a gap of at least five standard errors of either end
    low, high = anchors.random, anchors.reference
    error = max((end[1] - end[0]) / 3.92 for end in (low.ci95, high.ci95))
    assert high.mean - low.mean > 5 * error


def test_anchors_are_only_for_the_task_as_it_is():
    assert splits.with_anchors("shift", NAV.override(hazard_peak=0.9)).anchors is None
    assert splits.with_anchors("standard", NAV) is NAV
    (row,) = EvaluationJob(episodes=1, threads=1, split="ad_hoc").play_all(
        splits.with_anchors("ad_hoc", NAV), Random(3)
    )
    anchors = splits.anchors()["ad_hoc"]["hazard_nav-4"]
    low, high = anchors.random.mean, anchors.reference.mean
    assert row["score"] == pytest.approx((row["return"] - low) / (high - low))


def test_what_a_split_cannot_do_is_said():
    with pytest.raises(UnknownNameError, match="did you mean 'ad_hoc'"):
        EvaluationJob(split="ad_hok").play_all(NAV, Random(3))
    with pytest.raises(UnknownNameError, match="paper_nav-4: shift has no rules for its family"):
        EvaluationJob(split="shift").play_all(task_spec("paper_nav-4"), Random(2))
    with pytest.raises(BundleError, match="made for other bodies"):
        EvaluationJob(split="ad_hoc").play_all(task_spec("multiwalker_planar-3"), Random(4))
