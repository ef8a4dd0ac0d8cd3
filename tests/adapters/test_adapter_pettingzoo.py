"""PettingZoo: its own tests with warnings as errors, seeds of whole episodes, ids, pictures, AEC."""

import copy
import multiprocessing
import os
import pickle
import shutil
import subprocess
import sys
import warnings

import numpy as np
import pettingzoo
import pytest
from pettingzoo.test import api_test, parallel_api_test, parallel_seed_test
from pettingzoo.utils import aec_to_parallel, parallel_to_aec

import hipg_bench
import hipg_bench.errors
from hipg_bench.adapters.pettingzoo import HipgParallelEnv
from hipg_bench.rendering import gl

TASK = "hazard_nav-4"
DEADLY = {
    "hazard_nav-4": {"hazard_peak": 0.1, "hazard_radius": 2.0},
    "hazard_comm-10": {"hazard_peak": 0.3, "hazard_radius": 1.0},
    "multiwalker-3": {},
    "paper_nav-4": {"hazard_peak": 0.5, "hazard_radius": 1.0},
}
"""Hazards under which random teams lose members."""

UNBOUNDED = r"Agent's (min|max)imum observation space value is -?infinity"
"""Said of every environment that measures lengths and speeds; PettingZoo excepts its own by name."""
BLIND = "Observation numpy array is all zeros"
"""A dead agent sees its health 0 and zeros: that is the task."""

modes = pytest.mark.parametrize("dead", ["remove", "ghost"])


class Counted(HipgParallelEnv):
    """Counts deaths under actions that are the same each time."""

    deaths = 0

    def __init__(self, task, dead):
        super().__init__(task, dead, **DEADLY[task])
        for i, agent in enumerate(self.possible_agents):
            self.action_space(agent).seed(i)

    def step(self, actions):
        was = self._now.info["alive"].sum()
        told = super().step(actions)
        self.deaths += int(was - self._now.info["alive"].sum())
        return told


# PettingZoo's own tests


@modes
@pytest.mark.parametrize("task", DEADLY)
def test_pettingzoos_parallel_test_passes_while_agents_die(task, dead, capsys):
    env = Counted(task, dead)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        parallel_api_test(env, num_cycles=600)
    assert env.deaths > 0
    assert "Passed" in capsys.readouterr().out


@modes
@pytest.mark.parametrize("task", DEADLY)
def test_pettingzoos_aec_test_passes_while_agents_die(task, dead, capsys):
    env = Counted(task, dead)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", message=UNBOUNDED)
        warnings.filterwarnings("ignore", message=BLIND)
        api_test(parallel_to_aec(env), num_cycles=600)
    assert env.deaths > 0
    assert "Passed" in capsys.readouterr().out


@modes
def test_pettingzoos_seed_test_passes(dead):
    parallel_seed_test(lambda: HipgParallelEnv(TASK, dead, **DEADLY[TASK]))


# seeds


def shown(env, chance, steps=10**6):
    """Everything the environment says until the episode is over, as bytes per step."""
    out = []
    while env.agents and len(out) < steps:
        observations, *rest, infos = env.step({agent: chance.uniform(-1, 1, 3) for agent in env.agents})
        words = [observations, *rest, {agent: info["health"] for agent, info in infos.items()}]
        values = [np.ravel(value).astype(float) for word in words for value in word.values()]
        out.append(np.concatenate([*values, env.state()]).tobytes())
    return out


def two_episodes(seed, broken_off=0):
    """From a seed that is given when another seed's episode is ``broken_off`` steps old."""
    env = hipg_bench.parallel_env(TASK, seed=seed + 1, **DEADLY[TASK])
    env.reset()
    shown(env, np.random.default_rng(0), broken_off)
    chance = np.random.default_rng(seed)
    env.reset(seed=seed)
    first = shown(env, chance)
    env.reset()
    return first, shown(env, chance)


def test_a_seed_fixes_whole_episodes_also_after_a_reset_in_mid_episode_and_in_another_process():
    first, second = two_episodes(3)
    assert first[:10] != second[:10]
    assert two_episodes(3, broken_off=5) == (first, second)
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        assert pool.apply(two_episodes, (3,)) == (first, second)
    assert two_episodes(4)[0] != first


# the rest of the API


def test_spaces_hold_what_is_seen_and_are_each_agents_own():
    env = hipg_bench.parallel_env(TASK, dead="ghost", **DEADLY[TASK])
    observations, _ = env.reset(seed=0)
    assert env.possible_agents == env.agents == [f"agent_{i}" for i in range(4)]
    for agent in env.agents:
        assert env.observation_space(agent).contains(observations[agent])
        assert env.observation_space(agent) is env.observation_space(agent)
        assert env.action_space(agent) is env.action_space(agent)
        assert env.action_space(agent).dtype == np.float32
    assert env.action_space("agent_0") is not env.action_space("agent_1")
    assert env.state_space.contains(env.state())
    env.state()[:] = np.nan
    assert np.isfinite(env.state()).all()


def test_pettingzoo_makes_every_task_by_its_id():
    for name, spec in hipg_bench.tasks().items():
        assert pettingzoo.spec("parallel", f"hipg/{name}-v{spec.version}").kwargs == {"task": name}
    env = pettingzoo.make("parallel", "hipg/hazard_nav-4-v1", dead="ghost", horizon=7)
    assert isinstance(env, HipgParallelEnv)
    assert str(env) == "hazard_nav-4_v1"
    assert env.task_spec.horizon == 7


def test_pickle_and_deepcopy_go_on_where_it_was():
    env = hipg_bench.parallel_env(TASK, dead="ghost", **DEADLY[TASK])
    env.reset()
    env.step({agent: np.zeros(3) for agent in env.agents})
    twins = copy.deepcopy(env), pickle.loads(pickle.dumps(env))
    action = {agent: np.full(3, 0.5) for agent in env.agents}
    seen = env.step(action)[0]
    following, _ = env.reset()
    for twin in twins:
        np.testing.assert_array_equal(twin.step(action)[0]["agent_2"], seen["agent_2"])
        np.testing.assert_array_equal(twin.reset()[0]["agent_2"], following["agent_2"])
        assert twin.task_spec == env.task_spec


@modes
def test_an_aec_episode_pays_what_the_parallel_one_pays(dead):
    env = hipg_bench.parallel_env(TASK, dead=dead, **DEADLY[TASK])
    assert aec_to_parallel(parallel_to_aec(env)) is env
    chance = np.random.default_rng(0)
    told = {agent: chance.uniform(-1, 1, (50, 3)) for agent in env.possible_agents}
    env.reset(seed=1)
    sums, t = dict.fromkeys(env.agents, 0.0), 0
    while env.agents:
        _, rewards, *_ = env.step({agent: told[agent][t] for agent in env.agents})
        sums = {agent: value + rewards.get(agent, 0.0) for agent, value in sums.items()}
        t += 1
    aec = parallel_to_aec(env)
    aec.reset(seed=1)
    paid, turns = dict.fromkeys(aec.agents, 0.0), dict.fromkeys(aec.agents, 0)
    for agent in aec.agent_iter():
        _, reward, terminated, truncated, _ = aec.last()
        paid[agent] += reward
        aec.step(None if terminated or truncated else told[agent][turns[agent]])
        turns[agent] += 1
    assert paid == pytest.approx(sums)
    assert len(set(turns.values())) == (1 if dead == "ghost" else len(set(sums.values())))


# pictures


@pytest.mark.skipif(gl.working_backend() is None, reason=f"no OpenGL: {gl.INSTALL_COMMAND}")
@pytest.mark.parametrize("task", ["hazard_comm-10", "multiwalker-3", "paper_nav-4"])
def test_pictures_show_what_has_changed(task):
    env = hipg_bench.parallel_env(task, render_mode="rgb_array")
    assert env.render_mode in env.metadata["render_modes"]
    frames = []
    for _ in range(2):
        env.reset(seed=0)
        frames.append(env.render())
        for _ in range(4):
            env.step({agent: env.action_space(agent).high for agent in env.agents})
        frames.append(env.render())
    env.close()
    assert {frame.shape for frame in frames} == {(360, 640, 3)}
    assert {frame.dtype for frame in frames} == {np.dtype(np.uint8)}
    assert np.abs(frames[0].astype(int) - frames[1]).max() > 50
    # the same episode once more looks the same but for rounding, whatever was shown in between
    np.testing.assert_allclose(frames[0].astype(int), frames[2], atol=3)
    np.testing.assert_allclose(frames[1].astype(int), frames[3], atol=3)


@pytest.mark.skipif(gl.working_backend() is None, reason=f"no OpenGL: {gl.INSTALL_COMMAND}")
def test_a_renderer_that_dies_is_an_error_and_the_next_picture_comes_from_another():
    env, other = (hipg_bench.parallel_env("coop_nav-3", render_mode="rgb_array", seed=3) for _ in range(2))
    for one in (env, other):
        one.reset()
        one.render()
    env._live._child._process.kill()
    with pytest.raises(hipg_bench.errors.RenderError, match=r"coop_nav-3: .*ended by signal 9") as caught:
        env.render()
    assert "apt-get" not in str(caught.value)  # OpenGL works: nothing is missing
    np.testing.assert_array_equal(env.render(), other.render())
    for one in (env, other):
        one.step({agent: np.zeros(3) for agent in one.agents})
    # interpolated motion starts again in the second child, so a few pixels may differ
    assert np.abs(env.render().astype(int) - other.render()).mean() < 1
    env.close()
    other.close()


@pytest.mark.skipif(shutil.which("xvfb-run") is None, reason="no virtual display")
def test_a_window_shows_the_steps():
    code = (
        "import hipg_bench; e = hipg_bench.parallel_env('coop_nav-3', render_mode='human'); e.reset();"
        "[e.step({a: e.action_space(a).high for a in e.agents}) for _ in range(2)];"
        "print(e.render()); e.close()"
    )
    done = subprocess.run(
        ["xvfb-run", "-a", sys.executable, "-c", code],
        capture_output=True,
        text=True,
        timeout=200,
        check=False,
    )
    assert done.stdout.split() == ["None"], done.stderr


@pytest.mark.skipif("DISPLAY" in os.environ, reason="there is a display")
def test_without_a_display_a_window_is_refused_with_what_to_do():
    with pytest.raises(hipg_bench.errors.RenderError, match="DISPLAY is not set"):
        hipg_bench.parallel_env(TASK, render_mode="human")


def test_an_unknown_render_mode_is_refused():
    with pytest.raises(hipg_bench.errors.RenderError, match="hazard_nav-4: render modes 'human' and"):
        hipg_bench.parallel_env(TASK, render_mode="ansi")


def test_without_opengl_the_error_says_how_to_get_it():
    code = (
        "import hipg_bench; from hipg_bench.rendering import gl; gl.BACKENDS = ('nonsense',);"
        "gl.working_backend = lambda: None;"
        "e = hipg_bench.parallel_env('coop_nav-3', render_mode='rgb_array'); e.reset(); e.render()"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert "RenderError: coop_nav-3: no OpenGL works" in done.stderr
    assert gl.INSTALL_COMMAND in done.stderr
