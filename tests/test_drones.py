"""Drones and the relay task on hand-made worlds."""

import numpy as np
import pytest

from hipg_bench import BatchEnv, make
from hipg_bench.policies.scripted import Scripted


def relay(num_agents: int, **overrides: object) -> BatchEnv:
    env = make("hazard_comm-10", num_agents=num_agents, threads=1, **overrides)
    env.reset()
    return env


def arrange(env: BatchEnv, drones: list[list[float]], markers: list[list[float]], dead: tuple[int, ...] = ()):
    """Put drones at rest and markers in place, far from any hazard unless a marker says so."""
    env.arrange(position=drones, velocity=0.0, terminal=markers[:2], hazard=markers[2])
    return env.load_rows(np.array([0]), env.fork(env.rows, dict.fromkeys(dead, 0.0)))


FAR = [0.0, 5.0, 0.5]
ENDS = [[-1.0, 0, 0.5], [1.0, 0, 0.5]]


def test_top_speed_is_thrust_over_drag() -> None:
    env = make("hazard_nav-4", half_width=10.0, hazards=0)
    env.reset()
    env.arrange(position=[[0, y, 0.5] for y in range(4)])
    for _ in range(25):
        step = env.step(np.tile([1.0, 0, 0], (1, 4, 1)))
    speed = env.layout.state.view(step.info["state"], "velocity")[0]
    # 6 N / 4 N s/m = 1.5 m/s, with a time constant of 1 kg / 4 = 0.25 s: after 2.5 s all but e^-10 of it
    np.testing.assert_allclose(speed, np.tile([1.5, 0, 0], (4, 1)), atol=1e-3)


def test_a_live_drone_hovers_and_a_dead_one_falls() -> None:
    env = relay(2)
    arrange(env, [[0, 0.5, 0.5], [0, -0.5, 0.5]], [*ENDS, FAR], dead=(1,))
    for _ in range(20):
        step = env.step(np.zeros((1, 2, 3)))
    height = env.layout.state.view(step.info["state"], "position")[0, :, 2]
    assert height[0] == pytest.approx(0.5, abs=1e-6)
    assert height[1] == pytest.approx(0.03, abs=0.01)  # its radius above the floor


@pytest.mark.parametrize(
    ("places", "dead", "connected"),
    [
        # terminals at x = -1 and 1, links up to 0.6 m: relays at -0.5, 0, 0.5 leave gaps of 0.5
        ([-0.5, 0.0, 0.5], (), 1.0),
        # a gap of 0.7 between 0 and 0.7
        ([-0.5, 0.0, 0.7], (), 0.0),
        # the middle one is dead
        ([-0.5, 0.0, 0.5], (1,), 0.0),
        # two relays cannot span 2 m with three links of 0.6 m
        ([-0.4, 0.4, 0.4], (), 0.0),
    ],
)
def test_a_chain_pays_when_whole_and_alive(
    places: list[float], dead: tuple[int, ...], connected: float
) -> None:
    env = relay(3)
    # raised a little apart so that drones at one place do not push each other
    drones = [[x, 0.0, 0.5 + 0.08 * (i % 2)] for i, x in enumerate(places)]
    arrange(env, drones, [*ENDS, FAR], dead)
    assert env.step(np.zeros((1, 3, 3))).reward[0] == connected


def test_routes_tell_which_terminal_one_reaches() -> None:
    env = relay(3)
    # 0 and 1 hang together on terminal A; 2 is alone near B
    step = arrange(env, [[-0.6, 0, 0.5], [-0.1, 0, 0.5], [0.6, 0, 0.5]], [*ENDS, FAR])
    route = env.layout.observation.view(step.observation[0], "route")
    np.testing.assert_array_equal(route, [[1, 0], [1, 0], [0, 1]])


def test_wrecks_are_seen_and_live_drones_are_not_wrecks() -> None:
    env = relay(3)
    step = arrange(env, [[0, 0, 0.5], [0.3, 0, 0.5], [0, 0.4, 0.5]], [*ENDS, FAR], dead=(1,))
    layout = env.layout.observation
    seen = layout.view(step.observation[0], "wreck_seen")
    place = layout.view(step.observation[0], "wreck_position")
    np.testing.assert_array_equal(seen[0], [1, 0])
    np.testing.assert_allclose(place[0, 0], [0.3, 0, 0], atol=1e-6)
    neighbors = layout.view(step.observation[0], "neighbor_position")
    np.testing.assert_allclose(neighbors[0], [[0, 0.4, 0], [0, 0, 0]], atol=1e-6)


def test_the_hazard_lies_across_the_straight_chain() -> None:
    """Every episode: the segment between the terminals enters the sphere deeply enough to break a link."""
    env = make("hazard_comm-10", num_envs=256, threads=1)
    env.reset()
    params = env.spec.params
    for (a, b), hazard in zip(env.get_field("terminal"), env.get_field("hazard"), strict=True):
        line = (b - a) / np.linalg.norm(b - a)
        aside = np.linalg.norm(hazard - a - ((hazard - a) @ line) * line)
        # half the chord that the line cuts out of the sphere
        chord = 2 * np.sqrt(params["hazard_radius"] ** 2 - aside**2)
        assert chord > params["link_range"]


@pytest.mark.parametrize("task", ["hazard_nav-4", "hazard_comm-10", "coop_nav-3"])
def test_the_expert_beats_random_by_far(task: str) -> None:
    env = make(task, num_envs=32, threads=1)
    expert, chance = Scripted(env.spec), np.random.default_rng(0)
    returns = {}
    for name in ("expert", "random"):
        step = env.reset()
        for _ in range(env.spec.horizon):
            action = chance.uniform(-1, 1, (32, env.num_agents, 3))
            if name == "expert":
                action, _ = expert.act(step.info["state"], None, step.info["alive"])
            step = env.step(action)
        returns[name] = step.info["metrics"]["return"]
    assert returns["expert"].min() > np.median(returns["random"])
