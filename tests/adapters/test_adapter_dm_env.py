"""dm_env and dm_control: their own conformance suite, their viewer and their pixel wrapper."""

import importlib.util
import inspect
import itertools
import os
import shutil
import subprocess
import sys
import unittest
from pathlib import Path

import mujoco
import numpy as np
import pytest
from dm_control import suite
from dm_control.viewer import runtime
from dm_env import StepType, test_utils

from hipg_bench import make, task_spec, tasks
from hipg_bench.adapters.dm_env import ALL_TASKS, HipgEnvironment, load
from hipg_bench.errors import ActionError, HipgError, SpecError, UnknownNameError
from hipg_bench.rendering import gl

ROOT = Path(__file__).parents[2]
DEADLY = {"hazard_peak": 0.3, "hazard_radius": 2.0, "horizon": 20}
JOINT = {"joint": True}


def drawn(env, chance):
    """A random action in the structure of the action spec."""
    spec = env.action_spec()
    each = [chance.uniform(one.minimum, one.maximum, one.shape) for one in np.atleast_1d(spec)]
    return each if isinstance(spec, list) else each[0]


class Conformance(test_utils.EnvironmentTestMixin, unittest.TestCase):
    """dm_env's own suite, over several whole episodes."""

    task = ("hazard_nav", "4", {"random": 0, **DEADLY})

    def make_object_under_test(self):
        return load(*self.task)

    def make_action_sequence(self):
        chance = np.random.default_rng(0)
        for _ in range(120):
            yield drawn(self.environment, chance)


class ConformanceOfTheJointView(Conformance):
    task = ("hazard_nav", "4", {"random": 0, **DEADLY}, JOINT)


class ConformanceOfWalkers(Conformance):
    task = ("multiwalker", "3", {"random": 0})


class ConformanceOfThePaper(Conformance):
    task = ("paper_nav", "4", {"random": 0})


def whole_episode(env, chance):
    steps = [env.reset()]
    while not steps[-1].last():
        steps.append(env.step(drawn(env, chance)))
    return steps


# load, as the suite does it


def test_load_has_the_signature_of_the_suite():
    ours, theirs = inspect.signature(load).parameters, inspect.signature(suite.load).parameters
    assert [(p.name, p.default) for p in ours.values()] == [(p.name, p.default) for p in theirs.values()]


def test_all_tasks_are_pairs_that_can_be_loaded():
    assert {"-".join(pair) for pair in ALL_TASKS} == set(tasks())
    for domain, task in ALL_TASKS:
        env = load(domain, task, {"random": 0, "horizon": 2})
        assert env.reset().first()
        assert len(whole_episode(env, np.random.default_rng(0))) == 3
        assert env.control_timestep() == task_spec(f"{domain}-{task}").control_step


def test_random_is_a_seed_a_state_or_nothing():
    def points(random):
        return load("hazard_nav", "4", {"random": random}).reset().observation[0]["point_position"].tolist()

    assert points(3) == points(3) != points(4)
    assert points(np.random.RandomState(3)) == points(np.random.RandomState(3))
    assert points(None) != points(None)


@pytest.mark.parametrize(
    ("names", "task_kwargs", "environment_kwargs", "error", "message"),
    [
        (("hazard_nv", "4"), None, None, UnknownNameError, "did you mean 'hazard_nav-4'"),
        (("hazard_nav", "5"), None, None, UnknownNameError, "did you mean 'hazard_nav-"),
        (("hazard_nav", "4"), {"hazard_peek": 0.5}, None, SpecError, "did you mean 'hazard_peak'"),
        (("hazard_nav", "4"), {"random": -1}, None, SpecError, "seed = -1 is refused: a whole number"),
        (("hazard_nav", "4"), None, {"flat_observation": True}, SpecError, "no field 'flat_observation'"),
    ],
)
def test_what_cannot_be_loaded(names, task_kwargs, environment_kwargs, error, message):
    with pytest.raises(error, match=message):
        load(*names, task_kwargs, environment_kwargs)


# what it shows


@pytest.mark.parametrize("task", ["hazard_comm-10", "multiwalker-3", "paper_comm-10"])
def test_observations_are_the_blocks_of_the_layout_by_name(task):
    env, world = HipgEnvironment(task, 2), make(task, 1, 2)
    layout = world.layout.observation
    shown, flat = env.reset().observation, world.reset().observation[0]
    joint = HipgEnvironment(task, 2, joint=True).reset().observation
    assert len(shown) == world.num_agents
    for agent, seen in enumerate(shown):
        assert list(seen) == [block.name for block in layout.present]
        for block in layout.present:
            np.testing.assert_array_equal(seen[block.name], layout.view(flat, block.name)[agent])
            np.testing.assert_array_equal(seen[block.name], joint[block.name][agent])


def test_an_episode_is_over_with_discount_one_when_time_is_up_and_zero_when_the_rules_end_it():
    chance = np.random.default_rng(0)
    timed = whole_episode(load("coop_nav", "3", {"random": 0}), chance)
    assert len(timed) == task_spec("coop_nav-3").horizon + 1
    failed = whole_episode(load("multiwalker", "3", {"random": 0}), chance)
    assert len(failed) < task_spec("multiwalker-3").horizon
    for steps, last in ((timed, 1.0), (failed, 0.0)):
        assert [step.step_type for step in steps[1:]] == [StepType.MID] * (len(steps) - 2) + [StepType.LAST]
        assert [step.discount for step in steps[1:]] == [1.0] * (len(steps) - 2) + [last]


def test_the_dead_see_nothing_and_are_not_paid_after_the_step_of_their_death():
    env, chance = load("hazard_nav", "4", {"random": 0, **DEADLY}), np.random.default_rng(0)
    deaths = 0
    steps = whole_episode(env, chance)
    for was, now in itertools.pairwise(steps):
        for before, seen, reward in zip(was.observation, now.observation, now.reward, strict=True):
            assert (reward == 0) == (before["health"] == 0)
            if seen["health"] == 0:
                assert not any(array.any() for array in seen.values())
                deaths += before["health"].item()
    assert deaths > 1


def test_a_step_after_the_last_begins_the_next_episode():
    env, chance = load("hazard_nav", "4", {"random": 0, **DEADLY}), np.random.default_rng(0)
    whole_episode(env, chance)
    begun = env.step(drawn(env, chance))
    again = load("hazard_nav", "4", {"random": 0, **DEADLY})
    again.reset()
    second = again.reset()
    assert begun.first()
    for a, b in zip(begun.observation, second.observation, strict=True):
        np.testing.assert_array_equal(a["point_position"], b["point_position"])


@pytest.mark.parametrize(
    ("action", "error", "message"),
    [
        ([np.zeros(3)] * 3, ActionError, r"agent_3 is alive and needs an action of shape \(3,\)"),
        ([np.zeros(3)] * 5, UnknownNameError, "no agent 'agent_4'"),
        ([np.zeros(3), np.zeros(2)] * 2, ActionError, r"shape \(3,\) .* for agent_1, got .* shape \(2,\)"),
        ([np.zeros(3), np.full(3, np.nan)] * 2, ActionError, r"nan for env 0, agent 1 \(thrust"),
        ([np.zeros(3), "abc"] * 2, ActionError, "numbers of shape .* for agent_1"),
    ],
)
def test_actions_that_are_refused(action, error, message):
    env = load("hazard_nav", "4", {"random": 0})
    env.reset()
    with pytest.raises(error, match=f"hazard_nav-4: .*{message}"):
        env.step(action)


@pytest.mark.parametrize("action", [np.zeros(11), np.zeros((4, 3)), "abc"])
def test_a_joint_action_of_the_wrong_shape_is_refused(action):
    env = load("hazard_nav", "4", {"random": 0}, JOINT)
    env.reset()
    with pytest.raises(ActionError, match=r"hazard_nav-4: numbers of shape \(12,\) are allowed"):
        env.step(action)


def test_a_closed_environment_refuses_use():
    for use in (lambda env: env.step(np.zeros((4, 3))), lambda env: env.reset()):
        env = load("hazard_nav", "4", {"random": 0})
        env.reset()
        env.close()
        env.close()
        with pytest.raises(HipgError, match="hazard_nav-4: this environment is closed"):
            use(env)


# dm_control


def physics_state(model, data):
    state = np.empty(mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS))
    mujoco.mj_getState(model, data, state, mujoco.mjtState.mjSTATE_FULLPHYSICS)
    return state


@pytest.mark.parametrize("task", ["hazard_nav-4", "multiwalker-3"])
def test_the_physics_is_the_world_after_each_step_and_always_one_object(task):
    env, world = HipgEnvironment(task, 0), make(task, 1, 0, autoreset=False)
    data, chance, physics = mujoco.MjData(world.model), np.random.default_rng(0), env.physics
    for _ in range(2):
        env.reset()
        world.reset()
        for _ in range(8):
            mujoco.mj_setState(world.model, data, world.rows[0], mujoco.mjtState.mjSTATE_INTEGRATION)
            mujoco.mj_forward(world.model, data)
            assert env.physics is physics
            np.testing.assert_array_equal(
                physics_state(physics.model.ptr, physics.data.ptr), physics_state(world.model, data)
            )
            np.testing.assert_array_equal(physics.data.xpos, data.xpos)
            action = drawn(env, chance)
            env.step(action)
            world.step(np.stack(action)[None])


def test_a_camera_tells_the_dead_from_the_living():
    env, chance = load("hazard_nav", "4", {"random": 0, **DEADLY}), np.random.default_rng(0)
    step = env.reset()
    at_first, shown = env.physics.model.geom_rgba.copy(), env.physics.model
    names = [shown.id2name(k, "geom") for k in range(shown.ngeom)]
    while sum(seen["health"].item() for seen in step.observation) > 2:
        step = env.step(drawn(env, chance))
    now = env.physics.model.geom_rgba
    for agent, seen in enumerate(step.observation):
        parts = [k for k, name in enumerate(names) if name.startswith(f"drone{agent}/")]
        assert (now[parts] != at_first[parts]).any() == (seen["health"] == 0)
    assert sum(seen["health"].item() for seen in step.observation) > 0


def example(name):
    """A script of ``examples/`` as a module."""
    spec = importlib.util.spec_from_file_location(name, ROOT / "examples" / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_viewers_loop_plays_whole_episodes():
    env, policy = load("hazard_nav", "4", {"random": 0, "horizon": 10}), example("dm_viewer").policy
    said, told = [], []
    loop = runtime.Runtime(env, lambda step: told.append(step) or policy(step))
    loop.on_error += said.append
    for _ in range(2):
        told.clear()
        while loop.state is not runtime.State.STOPPED:
            loop.tick(0.1, paused=False)
        assert [step.first() for step in told] == [True] + [False] * 9
        assert loop.get_time() == pytest.approx(1.0)
        loop.tick(0.1, paused=True)
        loop.restart()
    assert not said


# what needs OpenGL is done in a child, whose backend can be chosen

PIXELS = """
import sys
import numpy as np
from dm_control.suite.wrappers import pixels
from hipg_bench.adapters.dm_env import load

env = load("multiwalker", "3", {"random": 0}, {"joint": True})
view = {"height": 48, "width": 64, "camera_id": "plank/follow"}
env = pixels.Wrapper(env, pixels_only=False, render_kwargs=view)
chance, step = np.random.default_rng(0), env.reset()
frames = [step.observation["pixels"]]
while not step.last():
    step = env.step(chance.uniform(-1, 1, env.action_spec().shape))
    frames.append(step.observation["pixels"])
    assert step.observation["pixels"].shape == env.observation_spec()["pixels"].shape
    assert step.observation["health"].shape == (3, 1)
np.save(sys.argv[1], np.stack(frames))
"""


def test_pixels_through_the_suites_wrapper(tmp_path):
    backend = gl.working_backend()
    if backend is None:
        pytest.skip(f"no OpenGL works here: {gl.INSTALL_COMMAND}")
    child = subprocess.run(
        [sys.executable, "-c", PIXELS, tmp_path / "frames.npy"], env=gl.environment(backend),
        capture_output=True, text=True, timeout=300, check=False,
    )  # fmt: skip
    assert child.returncode == 0, child.stderr
    frames = np.load(tmp_path / "frames.npy").astype(int)
    assert frames.shape[1:] == (48, 64, 3)
    # the plank fills part of the picture, and falls out of its place with the walkers
    assert all(frame.std() > 10 for frame in frames)
    changed = np.abs(frames[1:] - frames[:-1]).mean(axis=(1, 2, 3))
    assert (changed > 0).all()
    assert np.abs(frames[-1] - frames[0]).mean() > 5


WINDOW = """
import runpy
import sys
import glfw
import numpy as np
from dm_control.viewer import application
import hipg_bench

told = []

def policy(step):
    told.append(step)
    if len(told) == 12:
        glfw.set_window_should_close(app._window._context.window, True)
    return play(step)

play = runpy.run_path(sys.argv[1])["policy"]
app = application.Application(width=160, height=120)
app._window.keyboard._handle_key_event(None, glfw.KEY_SPACE, 0, glfw.PRESS, 0)
app.launch(hipg_bench.load("hazard_nav", "4", {"random": 0}), policy)
picture = app._renderer.pixels
begun, error = sum(step.first() for step in told), app._status._value["Error"]
print(len(told), begun, picture.shape, picture.std() > 5, error)
"""


@pytest.mark.skipif(shutil.which("xvfb-run") is None, reason="no display to try: apt-get install -y xvfb")
def test_the_viewers_window_opens_and_plays():
    child = subprocess.run(
        ["xvfb-run", "-a", sys.executable, "-c", WINDOW, ROOT / "examples" / "dm_viewer.py"],
        env=os.environ | {"MUJOCO_GL": "glfw"}, capture_output=True, text=True, timeout=300, check=False,
    )  # fmt: skip
    said = child.stdout.split()
    assert child.returncode == 0, child.stderr
    assert int(said[0]) >= 12
    assert child.stdout.split(" ", 1)[1] == "1 (120, 160, 3) True --\n"
