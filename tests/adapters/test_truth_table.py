"""What becomes of the dead, the same in every adapter: a row of the table is a test.

| event at step t | ``remove`` | ``ghost`` | ``joint`` |
|---|---|---|---|
| i dies, others live | told once more, terminated; then gone | stays, blind; not terminated | stays, blind |
| reward after death | none | 0, or the team's with ``reward_dead="team"`` | the team's |
| all dead | all gone, over | all terminated, once | as the task says |
| the rules end the episode | all live agents terminated | all terminated | terminated |
| time limit | all live agents truncated | all truncated | truncated |
| death at the time limit | i terminated, others truncated | all truncated, i not alive | truncated |
| actions for the dead | ignored | ignored | ignored |
| revival | never | never | never |
| keys of infos | always the same | always the same | always the same |

``joint`` adapters show the team as one agent. Its episode is the task's own, of which death is no end.
"""

import itertools

import numpy as np
import pytest
from drivers import ADAPTERS, open_adapter
from episodes import drawn, played, world

TASK = "hazard_nav-4"
SPREAD = {"hazard_peak": 0.1, "hazard_radius": 2.0}
"""A hazard that reaches everyone: deaths all along the episode."""
SWIFT = {"hazard_peak": 0.9, "hazard_radius": 3.0}
"""One that nobody survives for long."""

pytestmark = pytest.mark.parametrize("name", ADAPTERS)


def episode(name, task=TASK, seed=0, told=lambda actions: actions, **overrides):
    """The moments of one episode behind an adapter."""
    adapter, env = open_adapter(name, task, seed, **overrides), world(task, seed, **overrides)
    first, _ = adapter.reset(), env.reset()
    actions = told(drawn(env, seed, env.spec.horizon))
    moments = played(adapter, env, actions)
    adapter.close()
    return adapter.dead, first, moments


def only_some_died(moments):
    """The moments of deaths after which somebody is left."""
    return [t for t, moment in enumerate(moments) if moment.died.any() and moment.alive.any()]


def first_death(seed=0, **overrides):
    """Control step, from 1, at which somebody dies while others live on."""
    env = world(TASK, seed, **overrides)
    alive = env.reset().info["alive"]
    for t, action in enumerate(drawn(env, seed, env.spec.horizon), start=1):
        was, alive = alive, env.step(action[None]).info["alive"]
        if (was & ~alive).any() and alive.any():
            return t
    raise AssertionError("nobody dies: the test needs another hazard")


def test_at_first_everyone_is_there(name):
    _, first, _ = episode(name, **SPREAD)
    assert first.reported.all()
    assert first.live.all()
    assert first.alive.all()
    assert not first.over
    assert np.isfinite(first.observation).all()


def test_a_death_while_others_live(name):
    dead, _, moments = episode(name, **SPREAD)
    deaths = only_some_died(moments)
    assert deaths
    for moment, after in itertools.pairwise(moments):
        seen, died = moment.seen, moment.died
        np.testing.assert_array_equal(seen.alive, moment.alive)
        if seen.over or not moment.alive.any():
            continue
        assert not seen.truncated.any()
        if dead == "remove":
            np.testing.assert_array_equal(seen.reported, moment.lived)
            np.testing.assert_array_equal(seen.terminated, died)
            np.testing.assert_array_equal(seen.live, moment.alive)
            np.testing.assert_array_equal(after.seen.reported, moment.alive)
        else:
            assert seen.reported.all()
            assert seen.live.all()
            assert not seen.terminated.any()
            assert not after.seen.observation[~moment.alive].any()


def test_the_reward_of_the_step_of_death_and_after_it(name):
    dead, _, moments = episode(name, **SPREAD)
    assert only_some_died(moments)
    for moment in moments:
        team, paid = moment.step.reward[0], moment.seen.reward
        assert team < 0
        np.testing.assert_allclose(paid[moment.lived], team, rtol=1e-6)
        after = {"remove": np.nan, "ghost": 0.0, "joint": team}[dead]
        np.testing.assert_array_equal(paid[~moment.lived], after)


def test_the_dead_share_the_teams_reward_where_the_task_says_so(name):
    dead, _, moments = episode(name, **SWIFT, horizon=20, reward_dead="team")
    lost = next(t for t, moment in enumerate(moments) if not moment.alive.any())
    assert lost < 10
    if dead == "remove":
        assert len(moments) == lost + 1
    else:
        assert len(moments) == 20
        assert moments[-1].seen.truncated.all()
        assert not any(moment.seen.terminated.any() for moment in moments)
        for moment in moments:
            np.testing.assert_allclose(moment.seen.reward, moment.step.reward[0], rtol=1e-6)


def test_all_dead(name):
    dead, _, moments = episode(name, **SWIFT, horizon=20)
    lost = next(t for t, moment in enumerate(moments) if not moment.alive.any())
    assert lost < 10
    terminations = np.sum([moment.seen.terminated for moment in moments], axis=0)
    if dead == "joint":
        # the task goes on, for dying must not save a team from being charged
        assert len(moments) == 20
        assert not terminations.any()
        assert moments[-1].seen.truncated.all()
    else:
        assert len(moments) == lost + 1
        last = moments[-1].seen
        assert last.over
        assert not last.live.any()
        assert not last.truncated.any()
        # each agent is told once, at its own death or at the end
        np.testing.assert_array_equal(terminations, 1)
        assert last.terminated.all() or dead == "remove"


def test_the_last_death_at_the_time_limit_is_a_termination(name):
    _, _, moments = episode(name, **SWIFT, horizon=20)
    lost = next(t for t, moment in enumerate(moments, start=1) if not moment.alive.any())
    dead, _, moments = episode(name, **SWIFT, horizon=lost)
    last = moments[-1]
    assert len(moments) == lost
    assert last.seen.over
    if dead == "joint":
        assert last.seen.truncated.all()
    else:
        np.testing.assert_array_equal(last.seen.terminated, last.lived if dead == "remove" else True)
        assert not last.seen.truncated.any()


def test_the_rules_end_an_episode_of_which_some_are_alive(name):
    dead, _, moments = episode(name, "multiwalker-3", seed=1)
    last = moments[-1]
    assert last.step.terminated[0]
    assert last.alive.any()
    assert last.seen.over
    np.testing.assert_array_equal(last.seen.terminated, last.lived if dead == "remove" else True)
    assert not last.seen.truncated.any()
    assert not last.seen.live.any()


def test_the_time_limit(name):
    length = first_death(**SPREAD) + 2
    dead, _, moments = episode(name, **SPREAD, horizon=length)
    last = moments[-1]
    assert len(moments) == length
    assert last.alive.any()
    assert not last.alive.all()
    assert not last.died.any()
    assert last.seen.over
    np.testing.assert_array_equal(last.seen.truncated, last.lived if dead == "remove" else True)
    assert not last.seen.terminated.any()
    assert not last.seen.live.any()


def test_a_death_at_the_time_limit(name):
    length = first_death(**SPREAD)
    dead, _, moments = episode(name, **SPREAD, horizon=length)
    last = moments[-1]
    assert len(moments) == length
    assert last.died.any()
    assert last.alive.any()
    np.testing.assert_array_equal(last.seen.alive, last.alive)
    np.testing.assert_array_equal(last.seen.terminated, last.died & (dead == "remove"))
    np.testing.assert_array_equal(last.seen.truncated, last.alive if dead == "remove" else True)
    assert last.seen.over


@pytest.mark.parametrize("nonsense", [1.0, -1.0, 1e30, np.nan, np.inf])
def test_actions_for_the_dead_are_ignored(name, nonsense):
    _, _, plain = episode(name, **SPREAD, horizon=25)
    dead = np.array([~moment.lived for moment in plain])
    assert dead.any()

    def told(actions):
        return np.where(dead[..., None], np.float32(nonsense), actions[: len(dead)])

    _, _, other = episode(name, told=told, **SPREAD, horizon=25)
    assert len(other) == len(plain)
    for a, b in zip(plain, other, strict=True):
        np.testing.assert_array_equal(a.seen.observation, b.seen.observation)
        np.testing.assert_array_equal(a.seen.reward, b.seen.reward)
        np.testing.assert_array_equal(a.seen.terminated, b.seen.terminated)
        np.testing.assert_array_equal(a.seen.truncated, b.seen.truncated)


def test_nobody_is_revived_within_an_episode_and_everyone_in_the_next(name):
    adapter, env = open_adapter(name, TASK, **SWIFT, horizon=8), world(TASK, **SWIFT, horizon=8)
    for k in range(3):
        first = adapter.reset()
        env.reset()
        assert first.alive.all()
        assert first.live.all()
        moments = played(adapter, env, drawn(env, k, 8))
        assert not moments[-1].alive.all()
        for was, now in itertools.pairwise(moments):
            assert not (now.seen.alive & ~was.seen.alive).any()
            assert not (now.seen.live & ~was.seen.live).any()


def test_infos_always_have_the_same_keys(name):
    _, first, moments = episode(name, **SPREAD)
    assert only_some_died(moments)
    assert len(first.info_keys) == 1
    assert {moment.seen.info_keys for moment in moments} == {first.info_keys}
