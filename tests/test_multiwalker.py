"""The rules and senses of multi-walker, on poses made by hand."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from walkers import SPATIAL, put, root, snapshot, turn, world

from hipg_bench import BatchEnv, make
from hipg_bench.families.multiwalker import Snapshot


@pytest.fixture(scope="module")
def env() -> BatchEnv:
    env = make(SPATIAL, 1, threads=1)
    env.reset()
    return env


@pytest.fixture
def still(env: BatchEnv) -> Snapshot:
    env.reset()
    return snapshot(env)


def moved(now: Snapshot, body: int, by: tuple[float, float, float]) -> Snapshot:
    position = now.pose.position.copy()
    position[:, body] += by
    return dataclasses.replace(now, pose=dataclasses.replace(now.pose, position=position))


def tilted(now: Snapshot, body: int, up: float) -> Snapshot:
    """A body pitched forward until its up-axis has the vertical part ``up``."""
    rotation, sine = now.pose.rotation.copy(), math.sqrt(1 - up * up)
    rotation[:, body] = [[up, 0, sine], [0, 1, 0], [-sine, 0, up]]
    return dataclasses.replace(now, pose=dataclasses.replace(now.pose, rotation=rotation))


@pytest.mark.parametrize(
    ("pose", "cause"),
    [
        (lambda now: tilted(now, 1, 0.59), 0),
        # half of the standing height .6097 m is .305 m
        (lambda now: moved(now, 1, (0, 0, 0.304 - now.pose.position[0, 1, 2])), 1),
    ],
    ids=["tipped", "sunk"],
)
def test_three_steps_off_ones_feet_are_a_fall(
    env: BatchEnv, still: Snapshot, pose: Callable[[Snapshot], Snapshot], cause: int
):
    family, off = env.family, pose(still)
    was, fatal = still, []
    # off, off, on again: the count starts anew
    for now in (off, off, still, off, off, off, off):
        harm = family.harm(was, now)
        fatal.append(harm.fatal[0].tolist())
        assert (harm.exposure == 0).all()
        was = family.remember(env._sim, was, now)
    assert fatal == [[False, False, False]] * 5 + [[False, True, False]] * 2
    assert family.harm(was, off).cause[0, 1] == cause


@pytest.mark.parametrize(
    "pose",
    [
        lambda now: tilted(now, 1, 0.61),
        lambda now: moved(now, 1, (0, 0, 0.306 - now.pose.position[0, 1, 2])),
    ],
    ids=["leaning", "crouching"],
)
def test_less_is_no_fall(env: BatchEnv, still: Snapshot, pose: Callable[[Snapshot], Snapshot]):
    was = still
    for _ in range(10):
        now = pose(still)
        assert not env.family.harm(was, now).fatal.any()
        was = env.family.remember(env._sim, was, now)


def test_a_tipped_walker_dies_in_the_third_step_and_is_charged_once(env: BatchEnv):
    env.reset()
    data = world(env)
    walker = root(env, data, "walker2")
    walker[:] = [5.0, 0.0, 0.5, *turn((0, 1, 0), math.radians(80))]
    put(env, data)
    alive, charged = [], []
    for _ in range(6):
        step = env.step(np.zeros((1, 3, 6)))
        alive.append(bool(step.info["alive"][0, 2]))
        charged.append(step.info["terms"]["fall"][0])
    assert alive == [True, True, False, False, False, False]
    # the whole team's fall costs 12, one of three walkers' 4
    np.testing.assert_allclose(charged, [0, 0, -4, 0, 0, 0], atol=1e-12)


@pytest.mark.parametrize(
    ("way", "paid"),
    [(0.015, 0.015), (0.02, 0.02), (0.05, 0.02), (-0.05, -0.05), (0.0, 0.0)],
)
def test_progress_is_the_planks_way_up_to_the_capped_speed(
    env: BatchEnv, still: Snapshot, way: float, paid: float
):
    # 1 m/s for 0.02 s is 0.02 m; walkers that move alone earn nothing
    now = moved(moved(still, 3, (way, 0.3, 0.0)), 1, (0.2, 0.0, 0.0))
    assert env.family.reward(still, now)["progress"][0] == pytest.approx(paid, abs=1e-15)


@given(st.lists(st.floats(-0.2, 0.2), min_size=2, max_size=30))
@settings(max_examples=50, deadline=None)
def test_no_way_of_moving_earns_more_than_the_distance(env: BatchEnv, ways: list[float]):
    was = snapshot(env)
    total = 0.0
    for way in ways:
        now = moved(was, 3, (way, 0.0, 0.0))
        total += float(env.family.reward(was, now)["progress"][0])
        was = now
    assert total <= sum(ways) + 1e-9
    assert total <= 0.02 * len(ways) + 1e-9


def test_costs_by_hand(env: BatchEnv, still: Snapshot):
    action = np.zeros((1, 3, 6))
    action[0, 0, 0], action[0, 2, 5] = 1.0, -0.5
    later = action.copy()
    later[0, 0, 0] = 0.4
    was = dataclasses.replace(still, action=action, health=np.array([[1.0, 1.0, 0.0]]))
    now = dataclasses.replace(still, action=later, health=np.array([[0.0, 0.0, 0.0]]))
    terms = env.family.reward(was, now)
    assert terms["effort"][0] == pytest.approx((0.16 + 0.25) / 18)
    assert terms["jerk"][0] == pytest.approx(0.36 / 18)
    assert terms["fall"][0] == pytest.approx(2 / 3)
    assert terms["drop"][0] == 1  # nobody is left under the plank
    assert set(terms) == set(env.spec.weights)


@pytest.mark.parametrize(
    ("lowest", "health", "ends"),
    [
        (0.031, (1, 0, 0), ""),
        (0.029, (1, 1, 1), "dropped"),
        (0.031, (0, 0, 0), "all_fallen"),
        (0.029, (0, 0, 0), "dropped"),
    ],
)
def test_how_it_ends(env: BatchEnv, still: Snapshot, lowest: float, health: tuple[int, ...], ends: str):
    now = dataclasses.replace(still, plank_low=np.array([lowest]), health=np.array([health], np.float64))
    ruled, reason = env.family.terminated(now)
    assert ruled[0] == (ends != "")
    assert not ruled[0] or reason[0] == ends
    assert env.family.reward(now, now)["drop"][0] == ruled[0]


def test_a_dropped_plank_ends_the_episode_and_is_measured():
    env = make(SPATIAL, 2, threads=1)
    env.reset()
    data = world(env, 1)
    # beside the team, one step above the ground: at 2 m/s the edge at 0.05 m is below 0.03 m after 0.02 s
    root(env, data, "plank")[:3] = [0.3, 3.0, 0.13]
    data.joint("plank/root").qvel[2] = -2.0
    put(env, data, 1)
    step = env.step(np.zeros((2, 3, 6)))
    assert step.terminated.tolist() == [False, True]
    assert step.info["end_reason"].tolist() == ["", "dropped"]
    assert step.info["terms"]["drop"].tolist() == [0, -8]
    metrics = {name: value[1] for name, value in step.info["metrics"].items()}
    assert (metrics["dropped"], metrics["carriers"], metrics["tipped"], metrics["sunk"]) == (1, 3, 0, 0)
    assert abs(metrics["displacement"]) < 1e-3  # the plank was put aside before the step, not by it


def test_slip_is_the_planks_lead_over_its_live_carriers(env: BatchEnv, still: Snapshot):
    env.reset()
    now = moved(moved(moved(still, 3, (0.05, 0, 0)), 0, (0.02, 0, 0)), 2, (0.4, 0, 0))
    now = dataclasses.replace(now, health=np.array([[1.0, 1.0, 0.0]]))
    env.family.remember(env._sim, still, now)
    # live carriers went .02 and 0 m, on average .01 m; the dead one does not count
    assert env._sim.field["slip"][0, 0] == pytest.approx(0.04)
    assert env._sim.field["displacement"][0, 0] == pytest.approx(0.05)


# ---- the senses ------------------------------------------------------------------------------------------


def test_what_walkers_see_of_plank_and_neighbours():
    env = make(SPATIAL, 1, threads=1)
    env.reset()
    data = world(env)
    body = env.family.body
    assert body.height == pytest.approx(0.1 + 0.5 * math.cos(0.35) + 0.04)
    for i in range(3):
        root(env, data, f"walker{i}")[:] = [1.2 * i - 1.2, 0, body.height, 1, 0, 0, 0]
    root(env, data, "plank")[:] = [0, 0, body.height + 0.25, 1, 0, 0, 0]
    data.qvel = 0
    # walker 1 is 0.1 m left of the line and drifts on; walker 2 is dead; walker 0 leans back
    root(env, data, "walker1")[1] = 0.1
    data.joint("walker1/root").qvel[:2] = [0.3, 0.5]
    root(env, data, "walker0")[3:] = turn((0, 1, 0), -0.2)
    # the plank's nose is 0.1 rad up
    root(env, data, "plank")[3:] = turn((0, 1, 0), -0.1)
    put(env, data)
    env.load_rows(np.array([0]), env.fork(env.rows, {2: 0.0}))
    seen = env.family.observe(snapshot(env))[0]
    view = {
        block.name: env.layout.observation.view(seen, block.name) for block in env.layout.observation.blocks
    }
    assert seen.shape == (3, 66)
    assert view["neighbor_there"].tolist() == [[0, 1], [1, 1], [1, 0]]
    assert view["neighbor_health"].tolist() == [[0, 1], [1, 0], [1, 0]]
    np.testing.assert_allclose(view["neighbor_gap"][0], [[0, 0, 0], [0, 0.1, 0]], atol=1e-6)
    np.testing.assert_allclose(view["neighbor_gap"][1], [[0, -0.1, 0], [0, -0.1, 0]], atol=1e-6)
    np.testing.assert_allclose(view["neighbor_velocity"][2], [[0.3, 0.5, 0], [0, 0, 0]], atol=1e-6)
    np.testing.assert_allclose(view["plank_lie"], [[math.sin(0.1), 0, 0]] * 3, atol=1e-6)
    # leaning back, the world's up is towards one's front, and the world's front is below one's front
    np.testing.assert_allclose(view["up"][0], [math.sin(0.2), 0, math.cos(0.2)], atol=1e-6)
    np.testing.assert_allclose(view["heading"][0], [math.cos(0.2), 0, -math.sin(0.2)], atol=1e-6)
    np.testing.assert_allclose(view["velocity"][1], [0.3, 0.5, 0], atol=1e-6)
    # its head's top is .02 m below the plank's middle: the middle of the board's underside
    np.testing.assert_allclose(
        view["head_on_plank"][1], [-0.02 * math.sin(0.1), 0.1, -0.02 * math.cos(0.1)], atol=1e-6
    )


def test_no_place_in_the_world_is_seen():
    """Shifted along the ground, everything looks the same: the senses are local."""
    env = make(SPATIAL, 1, threads=1)
    env.reset()
    before = env.family.observe(snapshot(env))
    data = world(env)
    for name in ("walker0", "walker1", "walker2", "plank"):
        root(env, data, name)[:2] += [7.0, -3.0]
    put(env, data)
    np.testing.assert_allclose(env.family.observe(snapshot(env)), before, atol=1e-5)
