"""Every adapter agrees with `BatchEnv` step by step, bit for bit, over whole episodes with deaths."""

import numpy as np
import pytest
from drivers import ADAPTERS, open_adapter
from episodes import drawn, played, world

TASKS = {
    "hazard_nav-4": {"hazard_peak": 0.2, "hazard_radius": 2.0},
    "hazard_comm-10": {"hazard_peak": 0.3, "hazard_radius": 1.0},
    "multiwalker-3": {},
    "paper_nav-4": {"hazard_peak": 0.5, "hazard_radius": 1.0},
    "coop_nav-3": {},
}
"""With hazards under which random teams lose members."""
EPISODES = 3


def bits(array):
    """What must be equal."""
    return np.ascontiguousarray(array).tobytes()


@pytest.mark.parametrize("name", ADAPTERS)
@pytest.mark.parametrize("task", TASKS)
def test_a_face_shows_what_the_world_says(name, task):
    adapter, env = open_adapter(name, task, 5, **TASKS[task]), world(task, 5, **TASKS[task])
    deaths, lengths = 0, []
    for k in range(EPISODES):
        first, begun = adapter.reset(), env.reset()
        assert begun.info["episode_id"][0] == k
        assert bits(first.observation) == bits(begun.observation[0])
        assert first.state is None or bits(first.state) == bits(begun.info["state"][0])
        moments = played(adapter, env, drawn(env, k, env.spec.horizon))
        for moment in moments:
            check(adapter.dead, moment)
        deaths += int((~moments[-1].alive).sum())
        lengths.append(len(moments))
    assert deaths > 0 or task == "coop_nav-3"
    assert min(lengths) > 1
    adapter.close()


def check(dead, moment):
    seen, step = moment.seen, moment.step
    reported = moment.lived if dead == "remove" else np.ones_like(moment.lived)
    np.testing.assert_array_equal(seen.reported, reported)
    assert bits(seen.observation[reported]) == bits(step.observation[0][reported])
    assert seen.state is None or bits(seen.state) == bits(step.info["state"][0])
    np.testing.assert_array_equal(seen.alive, moment.alive)
    paid = moment.lived if dead == "ghost" else reported
    # some libraries keep rewards in float32
    assert bits(seen.reward[paid]) == bits(np.full(paid.sum(), step.reward[0], seen.reward.dtype))
    lost = dead != "joint" and not moment.alive.any()
    assert seen.over == bool(step.terminated[0] or step.truncated[0] or lost)


@pytest.mark.parametrize("name", ADAPTERS)
def test_a_seed_gives_the_same_episodes_whenever_it_is_given(name):
    task, numbers = "hazard_nav-4", TASKS["hazard_nav-4"]
    adapter, env = open_adapter(name, task, 1, **numbers), world(task, 1, **numbers)
    shown = []
    for broken_off in (0, 3):
        adapter.reset()
        for action in drawn(env, 9, broken_off):
            adapter.step(action)
        env.reset(seed=7)
        adapter.reset(seed=7)
        moments = played(adapter, env, drawn(env, 0, 50))
        env.reset()
        second = adapter.reset()
        moments += played(adapter, env, drawn(env, 1, 50))
        for moment in moments:
            check(adapter.dead, moment)
        shown.append(second.observation)
    assert bits(shown[0]) == bits(shown[1])
    adapter.close()
