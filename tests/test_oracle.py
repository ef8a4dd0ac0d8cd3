"""The batch engine and its fused arithmetic against plain loops written for these tests alone."""

from __future__ import annotations

import math

import mujoco
import numpy as np
import pytest
from play import actions, play, same, strike

import hipg_bench
from hipg_bench import BatchEnv, Step, make

TASKS = sorted(hipg_bench.tasks())
ROW = int(mujoco.mjtState.mjSTATE_INTEGRATION)
INPUTS = int(mujoco.mjtState.mjSTATE_CTRL | mujoco.mjtState.mjSTATE_QFRC_APPLIED)
MOTION = int(mujoco.mjtState.mjSTATE_FULLPHYSICS | mujoco.mjtState.mjSTATE_WARMSTART)


class PlainLoop:
    """One MjData after another: load the world, give it the inputs, step it."""

    def __init__(self, env: BatchEnv) -> None:
        self.model, self.data = env.model, mujoco.MjData(env.model)
        self.decimation, self.num_agents = env.decimation, env.num_agents
        # the paper suite's rule: the dead stand still at once (elsewhere they fall, roll and slide)
        self.stops_the_dead = "paper" in env.spec.tags

    def part(self, row: np.ndarray, spec: int) -> np.ndarray:
        """Components ``spec`` of a row."""
        mujoco.mj_setState(self.model, self.data, row, ROW)
        out = np.empty(mujoco.mj_stateSize(self.model, spec))
        mujoco.mj_getState(self.model, self.data, out, spec)
        return out

    def advance(self, row: np.ndarray, inputs: np.ndarray, health: np.ndarray) -> np.ndarray:
        """Motion of one world one control step later."""
        mujoco.mj_setState(self.model, self.data, row, ROW)
        mujoco.mj_setState(self.model, self.data, inputs, INPUTS)
        if self.stops_the_dead:
            self.data.qvel.reshape(self.num_agents, -1)[health == 0] = 0
        self.model.opt.disableactuator = sum(1 << i for i in range(self.num_agents) if health[i] == 0)
        for _ in range(self.decimation):
            mujoco.mj_step(self.model, self.data)
        self.model.opt.disableactuator = 0
        out = np.empty(mujoco.mj_stateSize(self.model, MOTION))
        mujoco.mj_getState(self.model, self.data, out, MOTION)
        return out


@pytest.mark.parametrize("threads", [1, 2, 7])
@pytest.mark.parametrize("task", TASKS)
def test_the_batch_moves_as_plain_mujoco_does(task: str, threads: int):
    env = make(task, 3, threads=threads, horizon=25)
    loop, step, compared, with_dead = PlainLoop(env), env.reset(), 0, 0
    for _ in range(28):
        step = strike(env, step)
        before, health = env.rows, step.info["health"]
        step = env.step(actions(env, step))
        done = step.terminated | step.truncated
        after = env.rows
        after[done] = step.info["final_rows"]
        for world in range(3):
            inputs = loop.part(after[world], INPUTS)
            expected = loop.advance(before[world], inputs, health[world])
            assert same(expected, loop.part(after[world], MOTION)), (task, world)
            compared += 1
            with_dead += bool((health[world] == 0).any())
    assert compared == 3 * 28
    assert with_dead > 5, "no world with a dead agent was compared"


@pytest.fixture(scope="module")
def navigation() -> BatchEnv:
    """Hazards so wide and deadly that random play meets them."""
    return make("hazard_nav-4", 5, threads=1, hazard_radius=0.7, hazard_peak=0.6, hazards=2, neighbors=2)


class NavigationByHand:
    """Observation and reward of hazard navigation, one world and one agent at a time, on MjData."""

    def __init__(self, env: BatchEnv) -> None:
        self.env, self.params, self.n = env, env.spec.params, env.num_agents
        self.data = mujoco.MjData(env.model)

    def load(self, row: np.ndarray) -> None:
        mujoco.mj_setState(self.env.model, self.data, row, ROW)
        mujoco.mj_forward(self.env.model, self.data)
        self.drone = [self.data.body(f"drone{i}/body").xpos.tolist() for i in range(self.n)]
        self.speed = [[self.data.joint(f"drone{i}/{axis}").qvel[0] for axis in "xyz"] for i in range(self.n)]
        self.point = [self.data.body(f"point{p}/marker").xpos.tolist() for p in range(self.n)]
        remembered = {
            name: self.env.get_field(name, row[None])[0] for name in ("health", "hazardous", "revealed")
        }
        self.health = remembered["health"].tolist()
        self.hazardous = remembered["hazardous"].tolist()
        self.revealed = remembered["revealed"].tolist()

    def reward(self) -> float:
        gaps = []
        for p in range(self.n):
            gap = self.params["uncovered_distance"]
            for i in range(self.n):
                if self.health[i] > 0:
                    gap = min(gap, math.dist(self.point[p], self.drone[i]))
            gaps.append(gap)
        touching = 0
        for i in range(self.n):
            for j in range(i):
                near = math.dist(self.drone[i], self.drone[j]) < 2 * self.params["drone_radius"]
                touching += self.health[i] > 0 and self.health[j] > 0 and near
        weights = self.env.spec.weights
        return weights["distance"] * sum(gaps) / self.n + weights["collision"] * touching

    def observation(self, i: int) -> list[float]:
        if self.health[i] == 0:
            return [0.0] * self.env.observation_size
        radius = self.params["sensing_radius"]
        own = self.drone[i]
        points = sorted(range(self.n), key=lambda p: math.dist(self.point[p], own))
        gaps = []
        for p in points:
            gap = radius
            for j in range(self.n):
                if j != i and self.health[j] > 0 and math.dist(self.drone[j], own) <= radius:
                    gap = min(gap, math.dist(self.point[p], self.drone[j]))
            gaps.append(gap)
        others = sorted(
            (j for j in range(self.n) if j != i and math.dist(self.drone[j], own) <= radius),
            key=lambda j: math.dist(self.drone[j], own),
        )[: self.params["neighbors"]]
        empty = self.params["neighbors"] - len(others)
        return [
            self.health[i], *self.speed[i], *own,
            *(self.point[p][k] - own[k] for p in points for k in range(3)),
            *(self.revealed[p] for p in points),
            *gaps,
            *[1.0] * len(others), *[0.0] * empty,
            *(self.health[j] for j in others), *[0.0] * empty,
            *(self.drone[j][k] - own[k] for j in others for k in range(3)), *[0.0] * (3 * empty),
            *(self.speed[j][k] - self.speed[i][k] for j in others for k in range(3)), *[0.0] * (3 * empty),
        ]  # fmt: skip


def test_navigation_by_hand(navigation: BatchEnv):
    env, by_hand = navigation, NavigationByHand(navigation)
    step: Step = env.reset()
    deaths = revealed = 0
    for _ in range(49):
        was = step.info["health"]
        step = env.step(actions(env, step))
        for world, row in enumerate(env.rows):
            by_hand.load(row)
            assert step.reward[world] == pytest.approx(by_hand.reward(), rel=1e-12)
            for i in range(env.num_agents):
                np.testing.assert_allclose(
                    step.observation[world, i], by_hand.observation(i), rtol=1e-6, atol=1e-7
                )
            revealed += sum(by_hand.revealed)
        deaths += int(((was > 0) & (step.info["health"] == 0)).sum())
    assert deaths > 3
    assert revealed > 20


def test_navigation_deaths_by_hand(navigation: BatchEnv):
    """An agent dies in the step in which its summed -log(1 - p) reaches its hazard threshold."""
    env, by_hand = navigation, NavigationByHand(navigation)
    step = env.reset()
    threshold = env.get_field("hazard_threshold")
    hazard = np.zeros_like(threshold)
    for _ in range(49):
        alive = step.info["alive"]
        step = env.step(actions(env, step))
        for world, row in enumerate(env.rows):
            by_hand.load(row)
            for i in range(env.num_agents):
                if not alive[world, i]:
                    continue
                for p in range(env.num_agents):
                    share = math.dist(by_hand.drone[i], by_hand.point[p]) / env.spec.params["hazard_radius"]
                    if by_hand.hazardous[p] and share < 1:
                        hazard[world, i] -= math.log(1 - env.spec.params["hazard_peak"] * (1 - share**2))
                lives = hazard[world, i] < threshold[world, i]
                assert step.info["alive"][world, i] == lives
    assert (hazard >= threshold).any()


def test_hazard_thresholds_are_exponential():
    """By Kolmogorov and Smirnov: 2,000 draws of Exp(1); the critical distance at 0.001 is 1.95 / sqrt(n)."""
    env = make("hazard_nav-4", 500, threads=1)
    env.reset()
    drawn = np.sort(env.get_field("hazard_threshold").ravel())
    law, n = 1 - np.exp(-drawn), len(drawn)
    gap = max(np.abs(law - np.arange(n) / n).max(), np.abs(law - np.arange(1, n + 1) / n).max())
    assert gap < 1.95 / math.sqrt(n)


def test_deaths_do_not_depend_on_who_else_is_there():
    """Paired random numbers: what one agent does cannot change another's hazard threshold."""
    env = make("hazard_nav-4", 2, threads=1)
    env.reset(np.array([5, 5]))
    first = env.get_field("hazard_threshold")
    assert same(first[0], first[1])
    play(env, env.reset(np.array([5, 6])), 3)
    assert same(env.get_field("hazard_threshold")[0].copy(), first[0])


@pytest.mark.parametrize("alive", [True, False])
def test_the_dead_reveal_nothing(alive: bool):
    """Agent 0 is put on the hazard, all others out of its reach, and agent 0 may be dead already."""
    env = make("hazard_nav-4", 1, threads=1)
    env.reset()
    (hazard,) = np.flatnonzero(env.get_field("hazardous")[0])
    place = env.get_field("position")[0]
    centre = env.get_field("point")[0, hazard]
    corners = np.array([[x, y, 0.1] for x in (-1.0, 1.0) for y in (-1.0, 1.0)])
    far = corners[np.argsort(-np.linalg.norm(corners - centre, axis=1))]
    place[0], place[1:] = centre, far[:3]
    rows = env.set_field(env.rows, "position", place[None])
    env.load_rows(np.array([0]), env.fork(rows, {} if alive else {0: 0.0}))
    assert env.get_field("revealed").sum() == 0
    env.step(np.zeros((1, 4, 3)))
    assert env.get_field("revealed")[0, hazard] == alive
    assert env.get_field("revealed").sum() == alive
