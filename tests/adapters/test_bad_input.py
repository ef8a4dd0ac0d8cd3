"""Errors that teach: they name the task, the agent, what was got and what is allowed."""

import re

import gymnasium
import numpy as np
import pytest

import hipg_bench
import hipg_bench.gym
from hipg_bench.adapters.gymnasium import HipgEnv
from hipg_bench.adapters.gymnasium_vector import HipgVectorEnv
from hipg_bench.errors import ActionError, HipgError, RenderError, SpecError, UnknownNameError

TASK = "hazard_nav-4"
SWIFT = {"hazard_peak": 0.9, "hazard_radius": 3.0}
modes = pytest.mark.parametrize("dead", ["remove", "ghost"])


def refused(kind, *words):
    """An error of a kind, with these words in this order."""
    return pytest.raises(kind, match=".*".join(re.escape(word) for word in words))


def zeros(env):
    return {agent: np.zeros(3, np.float32) for agent in env.possible_agents}


@pytest.fixture(params=["remove", "ghost"])
def env(request):
    """A PettingZoo environment at the start of an episode."""
    env = hipg_bench.parallel_env(TASK, dead=request.param)
    env.reset()
    return env


# PettingZoo


@pytest.mark.parametrize(
    ("action", "got"),
    [
        (np.zeros(2), "got float64 of shape (2,)"),
        (np.zeros((1, 3)), "got float64 of shape (1, 3)"),
        (0.5, "got float64 of shape ()"),
        (None, "got object of shape ()"),
        (["a", "b", "c"], "got <U1 of shape (3,)"),
    ],
)
def test_a_malformed_action(env, action, got):
    with refused(ActionError, "hazard_nav-4: numbers of shape (3,) are allowed for agent_2, ", got):
        env.step({**zeros(env), "agent_2": action})


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_an_action_that_is_not_finite(env, value):
    with refused(ActionError, "hazard_nav-4: finite ", f" got {value} for env 0, agent 3 (thrust[1])"):
        env.step({**zeros(env), "agent_3": np.array([0, value, 0], np.float32)})


def test_a_missing_action(env):
    actions = zeros(env)
    del actions["agent_1"]
    with refused(ActionError, "hazard_nav-4: agent_1 is alive and needs an action of shape (3,)"):
        env.step(actions)


@pytest.mark.parametrize("stranger", ["agent_4", "agnet_3"])
def test_an_unknown_agent(env, stranger):
    with refused(UnknownNameError, f"hazard_nav-4: no agent {stranger!r}; did you mean 'agent_"):
        env.step({**zeros(env), stranger: np.zeros(3)})
    with refused(UnknownNameError, f"hazard_nav-4: no agent {stranger!r}"):
        env.action_space(stranger)
    with refused(UnknownNameError, f"hazard_nav-4: no agent {stranger!r}"):
        env.observation_space(stranger)


def test_an_error_changes_nothing(env):
    env.reset(seed=0)
    twin = hipg_bench.parallel_env(TASK, dead="ghost")
    twin.reset(seed=0)
    with pytest.raises(ActionError):
        env.step({**zeros(env), "agent_3": np.full(3, np.nan)})
    mine, other = env.step(zeros(env)), twin.step(zeros(twin))
    np.testing.assert_array_equal(mine[0]["agent_0"], other[0]["agent_0"])
    assert mine[1] == other[1]


@modes
def test_a_step_before_the_first_reset(dead):
    env = hipg_bench.parallel_env(TASK, dead=dead)
    with refused(HipgError, "hazard_nav-4: reset() comes first"):
        env.step(zeros(env))
    with refused(HipgError, "hazard_nav-4: reset() comes first"):
        env.state()


@modes
@pytest.mark.parametrize("how", [{"horizon": 2}, SWIFT], ids=["time limit", "all dead"])
def test_a_step_after_the_end(dead, how):
    env = hipg_bench.parallel_env(TASK, dead=dead, **how)
    env.reset()
    while env.agents:
        env.step(zeros(env))
    with refused(HipgError, "hazard_nav-4: the episode is over: reset() comes before the next step"):
        env.step(zeros(env))
    env.reset()
    env.step(zeros(env))


@modes
def test_use_after_close(dead):
    env = hipg_bench.parallel_env(TASK, dead=dead)
    env.reset()
    env.close()
    env.close()
    with refused(HipgError, "hazard_nav-4: this environment is closed"):
        env.reset()
    with refused(HipgError, "hazard_nav-4: ", "closed"):
        env.step(zeros(env))
    with refused(HipgError, "hazard_nav-4: ", "closed"):
        env.state()


@pytest.mark.parametrize("action", [np.full(3, np.nan), np.zeros(7), None, "nonsense"])
def test_whatever_the_dead_are_told_is_ignored(action):
    env = hipg_bench.parallel_env(TASK, dead="ghost", hazard_peak=0.1, hazard_radius=2.0)
    _, infos = env.reset()
    while all(info["alive"] for info in infos.values()):
        *_, infos = env.step(zeros(env))
    dead = [agent for agent, info in infos.items() if not info["alive"]]
    assert len(dead) < 4
    env.step({**zeros(env), **dict.fromkeys(dead, action)})
    env.step({agent: action for agent, action in zeros(env).items() if agent not in dead})


def test_unknown_names_are_met_with_the_nearest():
    with refused(SpecError, "hazard_nav-4: dead = 'ghosts' is refused; did you mean 'ghost'?"):
        hipg_bench.parallel_env(TASK, dead="ghosts")
    with refused(UnknownNameError, "did you mean 'hazard_nav-4'?"):
        hipg_bench.parallel_env("hazard_nav4")
    with refused(SpecError, "no field 'horizn'; did you mean 'horizon'?"):
        hipg_bench.parallel_env(TASK, horizn=3)
    with refused(SpecError, "hazard_nav-4: reward_dead = 'some' is refused"):
        hipg_bench.parallel_env(TASK, reward_dead="some")


@pytest.mark.parametrize("adapter", [hipg_bench.parallel_env, HipgEnv])
def test_a_picture_before_the_first_reset_or_after_close(adapter):
    env = adapter(TASK, render_mode="rgb_array")
    with refused(RenderError, "hazard_nav-4: nothing to render before reset() and after close()"):
        env.render()
    env.reset()
    env.close()
    with refused(RenderError, "hazard_nav-4: nothing to render before reset() and after close()"):
        env.render()


# Gymnasium


@pytest.fixture(params=["one", "many"])
def joint(request):
    """The environment, and the axes before N * A."""
    if request.param == "one":
        return gymnasium.make(f"hipg/{TASK}-v1", disable_env_checker=True), ()
    return HipgVectorEnv(TASK, 2, "Disabled"), (2,)


def test_a_joint_action_of_a_wrong_shape_or_kind(joint):
    env, lead = joint
    env.reset()
    allowed = f"hazard_nav-4: numbers of shape {(*lead, 12)} are allowed"
    for action in (np.zeros((*lead, 4, 3)), np.zeros(11), np.full((*lead, 12), "a"), None):
        with refused(ActionError, allowed):
            env.step(action)


def test_a_joint_action_that_is_not_finite(joint):
    env, lead = joint
    env.reset()
    action = np.zeros((*lead, 12), np.float32)
    action[..., 7] = np.nan
    with refused(ActionError, "hazard_nav-4: ", " got nan for env 0, agent 2 (thrust[1])"):
        env.step(action)


def test_a_joint_step_before_the_reset_after_the_end_and_after_close(joint):
    env, lead = joint
    action = np.zeros((*lead, 12), np.float32)
    with refused(HipgError, "hazard_nav-4: step() before reset()"):
        env.step(action)
    env.reset()
    for _ in range(50):
        env.step(action)
    with refused(HipgError, "hazard_nav-4: env 0 is waiting for reset(), its episode is over"):
        env.step(action)
    env.reset()
    env.close()
    with refused(HipgError, "hazard_nav-4: this environment is closed"):
        env.step(action)
    with refused(HipgError, "hazard_nav-4: this environment is closed"):
        env.reset()


def test_unknown_names_are_met_with_the_nearest_here_too():
    with refused(UnknownNameError, "did you mean 'hazard_nav-4'?"):
        HipgEnv("hazard_nav4")
    with refused(SpecError, "no field 'horizn'; did you mean 'horizon'?"):
        gymnasium.make(f"hipg/{TASK}-v1", horizn=3)
    with refused(SpecError, "no field 'horizn'; did you mean 'horizon'?"):
        gymnasium.make_vec(f"hipg/{TASK}-v1", 2, horizn=3)
    with refused(RenderError, "hazard_nav-4: the render mode 'rgb_array' is allowed, got 'human'"):
        HipgEnv(TASK, render_mode="human")


def test_drawing_that_gymnasium_asks_for_and_we_do_not_have():
    """What to do instead is said, and no field of the task is suggested."""
    with refused(SpecError, f"{TASK}: 'width' is refused: pictures are 640 x 360", "hipg-bench video"):
        gymnasium.make(f"hipg/{TASK}-v1", width=320)
    with refused(SpecError, "'height' is refused"):
        gymnasium.make_vec(f"hipg/{TASK}-v1", num_envs=2, height=200)
    with refused(RenderError, "many worlds are not drawn", "vectorization_mode='sync'"):
        gymnasium.make_vec(f"hipg/{TASK}-v1", num_envs=2, render_mode="rgb_array")
    envs = gymnasium.make_vec(
        f"hipg/{TASK}-v1", num_envs=2, vectorization_mode="sync", render_mode="rgb_array"
    )
    assert envs.num_envs == 2
    envs.close()
