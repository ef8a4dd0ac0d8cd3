"""Properties 1 to 4 of health in the paper, on the law of damage and on whole tasks."""

from __future__ import annotations

import inspect
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from play import actions

from hipg_bench import BatchEnv, make
from hipg_bench.engine import apply_damage
from hipg_bench.mechanics import hazards

SEEDS = st.integers(0, 2**32 - 1)
LEVELS = (1.0, 0.75, 0.25, 0.0)
"""Healths that the same agent is put to in four copies of a world."""
TASKS = ["hazard_nav-4", "hazard_comm-10", "multiwalker-3"]


def damage(health, cumulative_hazard, threshold, gained, fatal, *, graded):
    """Health and cumulative hazard (N,) after one step of the engine's rule."""
    w = SimpleNamespace(
        health=health.copy(), cumulative_hazard=cumulative_hazard.copy(), hazard_threshold=threshold,
        elapsed=1.0, death_time=np.full(len(health), -1.0), death_cause=np.zeros(len(health)),
    )  # fmt: skip
    scratch = SimpleNamespace(harm=gained, fatal=fatal, cause=np.ones(len(health)))
    for i in range(len(health)):
        inspect.unwrap(apply_damage)(w, scratch, SimpleNamespace(graded_health=graded), i)
    return w.health, w.cumulative_hazard


def harm(seed: int, steps: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Hazard threshold (N,), hazard gained (steps, N), killed outright (steps, N) of ten agents."""
    rng = np.random.default_rng(seed)
    gained = rng.exponential(0.2, (steps, 10)) * (rng.random((steps, 10)) < 0.5)
    return rng.exponential(1.0, 10), gained, rng.random((steps, 10)) < 0.02


@given(SEEDS, st.booleans())
def test_health_falls_for_good(seed: int, graded: bool):
    threshold, gained, fatal = harm(seed, 30)
    now, hazard = np.ones(10), np.zeros(10)
    for gain, kill in zip(gained, fatal, strict=True):
        was, had = now, hazard
        now, hazard = damage(was, had, threshold, gain, kill, graded=graded)
        assert (now <= was).all()
        assert ((now >= 0) & (now <= 1)).all()
        assert (now[kill] == 0).all()
        assert (now[was == 0] == 0).all()
        assert (hazard[was == 0] == had[was == 0]).all(), "the dead gather nothing"
        if not graded:
            assert np.isin(now, (0.0, 1.0)).all()
        else:
            # the share of threshold left, by hand: whoever lives has 1 - hazard / threshold
            alive = now > 0
            np.testing.assert_allclose(now[alive], (1 - hazard / threshold)[alive], rtol=1e-12)


@given(SEEDS)
def test_grading_changes_no_death(seed: int):
    threshold, gained, fatal = harm(seed, 30)
    fates = []
    for graded in (False, True):
        now, hazard = np.ones(10), np.zeros(10)
        for gain, kill in zip(gained, fatal, strict=True):
            now, hazard = damage(now, hazard, threshold, gain, kill, graded=graded)
        fates.append(now == 0)
    assert (fates[0] == fates[1]).all()


@given(SEEDS, st.floats(1.0, 5.0))
def test_more_harm_never_helps(seed: int, factor: float):
    threshold, gained, fatal = harm(seed, 20)
    one = two = np.ones(10)
    less = more = np.zeros(10)
    for gain, kill in zip(gained, fatal, strict=True):
        one, less = damage(one, less, threshold, gain, kill, graded=True)
        two, more = damage(two, more, threshold, factor * gain, kill, graded=True)
        assert (two <= one).all()


def test_survival_is_the_product_of_coins():
    """Hazard threshold drawn once against a plain loop that flips one coin per step.

    Both counts of survivors of M agents are binomial with the exact chance prod(1 - p); 4.5 standard
    errors hold with probability 0.99999 per comparison.
    """
    m, risks = 40_000, (0.05, 0.3, 0.0, 0.12, 0.4)
    rng = np.random.default_rng(5)
    now, hazard = np.ones(m), np.zeros(m)
    threshold, nobody = rng.exponential(1.0, m), np.zeros(m, bool)
    coins = np.ones(m, bool)
    chance = 1.0
    for p in risks:
        gained = np.full(m, inspect.unwrap(hazards.hazard_rate)(p, 1.0))
        now, hazard = damage(now, hazard, threshold, gained, nobody, graded=False)
        coins &= rng.random(m) >= p
        chance *= 1 - p
        error = np.sqrt(chance * (1 - chance) / m)
        assert (now > 0).mean() == pytest.approx(chance, abs=4.5 * error)
        assert coins.mean() == pytest.approx(chance, abs=4.5 * error)


@pytest.fixture(scope="module", params=[(t, g) for t in TASKS for g in (False, True)], ids=str)
def env(request: pytest.FixtureRequest) -> BatchEnv:
    task, graded = request.param
    return make(task, 4, threads=1, graded_health=graded)


def weakened(env: BatchEnv, episode: int) -> np.ndarray:
    """Rows of one world four times, agent 1's health at one of `LEVELS` in each."""
    env.reset(np.full(4, episode))
    rows = env.rows[[0]]
    return np.concatenate([env.fork(rows, {1: level}) for level in LEVELS])


def moved(env: BatchEnv, rows: np.ndarray, told: np.ndarray) -> np.ndarray:
    """(4, nq) where the worlds are one step after being told something."""
    env.load_rows(np.arange(4), rows)
    env.step(told)
    return env.get_field("position" if "position" in env.fields else "coordinate")


@settings(max_examples=8, deadline=None)
@given(episode=st.integers(0, 10_000))
def test_health_at_zero_stays_there(env: BatchEnv, episode: int):
    """Property 1, whatever the actions."""
    step = env.load_rows(np.arange(4), weakened(env, episode))
    for _ in range(6):
        was = step.info
        step = env.step(actions(env, step))
        goes_on = step.info["episode_id"] == was["episode_id"]
        assert (step.info["health"] <= was["health"])[goes_on].all()
        assert not step.info["final_alive"][3, 1] or was["elapsed"][3] == 0


@settings(max_examples=8, deadline=None)
@given(episode=st.integers(0, 10_000), seed=SEEDS)
def test_less_health_reaches_less(env: BatchEnv, episode: int, seed: int):
    """Properties 2 and 3: whatever a weaker agent does, a stronger one can do too.

    Graded health scales what an agent asks for, so the stronger one imitates the weaker by asking for
    less. Binary health is whole until it is nothing.
    """
    rows = weakened(env, episode)
    told = np.repeat(np.random.default_rng(seed).uniform(-1, 1, (1, env.num_agents, env.action_size)), 4, 0)
    if env.spec.graded_health:
        told[0, 1] *= LEVELS[2] / LEVELS[0]
        told[1, 1] *= LEVELS[2] / LEVELS[1]
    place = moved(env, rows, told)
    np.testing.assert_array_equal(place[0], place[2])
    np.testing.assert_allclose(place[1], place[2], rtol=1e-9, atol=1e-12)
    assert not (place[3] == place[2]).all(), "an action must do something"


@settings(max_examples=8, deadline=None)
@given(episode=st.integers(0, 10_000), seed=SEEDS)
def test_the_dead_reach_one_state_alone(env: BatchEnv, episode: int, seed: int):
    """Properties 2 and 3 at health 0: every action leads to the same state."""
    rows = np.repeat(weakened(env, episode)[[3]], 4, axis=0)
    told = np.zeros((4, env.num_agents, env.action_size))
    told[:, 1] = np.random.default_rng(seed).uniform(-1, 1, (4, env.action_size))
    place = moved(env, rows, told)
    assert (place == place[0]).all()


@settings(max_examples=8, deadline=None)
@given(episode=st.integers(0, 10_000))
def test_the_dead_see_one_thing_only(env: BatchEnv, episode: int):
    """Property 4: in worlds that differ, dead agents' observations do not."""
    env.reset(episode + np.arange(4))
    step = env.load_rows(np.arange(4), env.fork(env.rows, {1: 0.0}))
    assert (step.observation[:, 1] == step.observation[0, 1]).all()
    assert not (step.observation[1:, 0] == step.observation[0, 0]).all()
    assert np.count_nonzero(step.observation[:, 1]) == 0
