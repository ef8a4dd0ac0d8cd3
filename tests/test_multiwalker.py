"""The rules and senses of multi-walker, on poses made by hand."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from one_world import OneWorld
from walkers import SPATIAL, put, read, root, turn, world

from hipg_bench import BatchEnv, make
from hipg_bench.families.walker_body import body_of


@pytest.fixture(scope="module")
def env() -> BatchEnv:
    env = make(SPATIAL, 1, threads=1)
    env.reset()
    return env


@pytest.fixture
def one(env: BatchEnv) -> OneWorld:
    """A world at its start; the step before was the same."""
    env.reset()
    one = read(env)
    one.previous.x[:] = one.scratch.place[:, 0]
    return one


Pose = Callable[[OneWorld], None]


def tilt(one: OneWorld, up: float) -> None:
    """Pitch walker 1 forward until its up-axis has the vertical part ``up``."""
    sine = math.sqrt(1 - up * up)
    one.scratch.turn[1] = [[up, 0, sine], [0, 1, 0], [-sine, 0, up]]


def lower(one: OneWorld, height: float) -> None:
    """Put walker 1's torso at a height, m."""
    one.scratch.place[1, 2] = height


def stand(one: OneWorld) -> None:
    """Leave everything as it is."""


def is_fatal(one: OneWorld, pose: Pose) -> list[bool]:
    """Whom one more step in a pose kills."""
    one.read()
    pose(one)
    one.step("harm")
    assert (one.scratch.harm == 0).all()
    return one.scratch.fatal.astype(bool).tolist()


@pytest.mark.parametrize(
    ("pose", "cause"),
    # half of the standing height .6097 m is .305 m
    [(lambda one: tilt(one, 0.59), 0), (lambda one: lower(one, 0.304), 1)],
    ids=["tipped", "sunk"],
)
def test_three_steps_off_ones_feet_are_a_fall(one: OneWorld, pose: Pose, cause: int):
    # off, off, on again: the count starts again
    fatal = [is_fatal(one, each) for each in (pose, pose, stand, pose, pose, pose, pose)]
    assert fatal == [[False, False, False]] * 5 + [[False, True, False]] * 2
    assert one.scratch.cause[1] == cause


@pytest.mark.parametrize(
    "pose", [lambda one: tilt(one, 0.61), lambda one: lower(one, 0.306)], ids=["leaning", "crouching"]
)
def test_less_is_no_fall(one: OneWorld, pose: Pose):
    assert not any(any(is_fatal(one, pose)) for _ in range(10))


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
def test_progress_is_the_planks_way_up_to_the_capped_speed(one: OneWorld, way: float, paid: float):
    # 1 m/s for 0.02 s is 0.02 m; walkers that move alone earn nothing
    one.scratch.place[3] += (way, 0.3, 0.0)
    one.scratch.place[1] += (0.2, 0.0, 0.0)
    assert one.reward()["progress"] == pytest.approx(paid, abs=1e-15)


@given(st.lists(st.floats(-0.2, 0.2), min_size=2, max_size=30))
@settings(max_examples=50, deadline=None)
def test_no_way_of_moving_earns_more_than_the_distance(env: BatchEnv, ways: list[float]):
    one, total = read(env), 0.0
    for way in ways:
        one.previous.x[:] = one.scratch.place[:, 0]
        one.scratch.place[3, 0] += way
        total += one.reward()["progress"]
    assert total <= sum(ways) + 1e-9
    assert total <= 0.02 * len(ways) + 1e-9


def test_costs_by_hand(env: BatchEnv, one: OneWorld):
    one.previous.control[0, 0], one.previous.control[2, 5] = 1.0, -0.5
    one.w.control[0, 0], one.w.control[2, 5] = 0.4, -0.5
    one.previous.health[:], one.w.health[:] = (1, 1, 0), (0, 0, 0)
    terms = one.reward()
    assert terms["effort"] == pytest.approx((0.16 + 0.25) / 18)
    assert terms["jerk"] == pytest.approx(0.36 / 18)
    assert terms["fall"] == pytest.approx(2 / 3)
    assert terms["drop"] == 1  # nobody is left under the plank
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
def test_how_it_ends(one: OneWorld, lowest: float, health: tuple[int, ...], ends: str):
    one.scratch.plank_low, one.w.health[:] = lowest, health
    reason = one.call("end", one.w, one.scratch, one.task)
    assert one.definition.reasons[reason] == ends
    assert one.reward()["drop"] == (ends != "")


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


def test_slip_is_the_planks_lead_over_its_live_carriers(one: OneWorld):
    one.scratch.place[:, 0] += (0.02, 0.0, 0.4, 0.05)
    one.w.health[:] = (1, 1, 0)
    one.step("update")
    # live carriers went .02 and 0 m, on average .01 m; the dead one does not count
    assert one.w.slip == pytest.approx(0.04)
    assert one.w.displacement == pytest.approx(0.05)


# ---- the senses ------------------------------------------------------------------------------------------


def test_what_walkers_see_of_plank_and_neighbours():
    env = make(SPATIAL, 1, threads=1)
    env.reset()
    data = world(env)
    body = body_of(planar=False)
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
    step = env.load_rows(np.array([0]), env.fork(env.rows, {2: 0.0}))
    seen = step.observation[0]
    view = {
        block.name: env.layout.observation.view(seen, block.name) for block in env.layout.observation.blocks
    }
    assert seen.shape == (3, 66)
    assert view["neighbor_there"].tolist() == [[0, 1], [1, 1], [0, 0]]  # the dead observe nothing
    assert view["neighbor_health"].tolist() == [[0, 1], [1, 0], [0, 0]]
    np.testing.assert_allclose(view["neighbor_gap"][0], [[0, 0, 0], [0, 0.1, 0]], atol=1e-6)
    np.testing.assert_allclose(view["neighbor_gap"][1], [[0, -0.1, 0], [0, -0.1, 0]], atol=1e-6)
    np.testing.assert_allclose(view["neighbor_velocity"][0], [[0, 0, 0], [0.3, 0.5, 0]], atol=1e-6)
    np.testing.assert_allclose(view["plank_lie"][:2], [[math.sin(0.1), 0, 0]] * 2, atol=1e-6)
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
    before = env.arrange().observation
    data = world(env)
    for name in ("walker0", "walker1", "walker2", "plank"):
        root(env, data, name)[:2] += [7.0, -3.0]
    put(env, data)
    np.testing.assert_allclose(env.arrange().observation, before, atol=1e-5)
