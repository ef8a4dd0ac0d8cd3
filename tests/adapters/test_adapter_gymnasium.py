"""Gymnasium: its own checks, its own vector environment as the oracle of ours, ids, seeds, pictures."""

import re
import subprocess
import sys
import warnings

import gymnasium
import numpy as np
import pytest
from episodes import drawn
from gymnasium.utils.env_checker import check_env, data_equivalence
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers.vector import DictInfoToList, RecordEpisodeStatistics

import hipg_bench
import hipg_bench.errors
import hipg_bench.gym
from hipg_bench.adapters.gymnasium import HipgEnv
from hipg_bench.adapters.gymnasium_vector import HipgVectorEnv
from hipg_bench.rendering import gl

TASK = "hazard_nav-4"
DEADLY = {"hazard_peak": 0.2, "hazard_radius": 2.0}
UNBOUNDED = r".*A Box observation space (min|max)imum value is -?infinity"
"""Said of every environment that measures lengths and speeds, Gymnasium's own MuJoCo ones too."""


# single environments


@pytest.mark.parametrize("task", ["hazard_nav-4", "hazard_comm-10", "multiwalker-3", "paper_nav-4"])
def test_gymnasiums_own_check_finds_nothing(task):
    env = gymnasium.make(f"hipg/{task}-v1", disable_env_checker=True)
    pictures = task == TASK and gl.working_backend() is not None
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", message=UNBOUNDED)
        check_env(env.unwrapped, skip_render_check=not pictures)


def test_every_task_has_an_id_with_its_version():
    for name, spec in hipg_bench.tasks().items():
        entry = gymnasium.spec(f"hipg/{name}-v{spec.version}")
        assert entry.kwargs == {"task": name}


def test_an_id_that_names_the_module_needs_no_import():
    code = (
        "import gymnasium as g; e = g.make('hipg_bench.gym:hipg/hazard_nav-4-v1', horizon=7);"
        "v = g.make_vec('hipg_bench.gym:hipg/hazard_nav-4-v1', num_envs=3);"
        "print(e.unwrapped.task_spec.horizon, type(v).__name__, v.num_envs)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["7", "HipgVectorEnv", "3"]


def test_the_joint_vectors_are_the_agents_one_after_another():
    env, world = HipgEnv(TASK), hipg_bench.make(TASK, 1)
    observation, info = env.reset(seed=3)
    begun = world.reset(seed=3)
    np.testing.assert_array_equal(observation.reshape(4, -1), begun.observation[0])
    np.testing.assert_array_equal(info["state"], begun.info["state"][0])
    action = np.arange(12, dtype=np.float32) / 12
    step = world.step(action.reshape(1, 4, 3))
    observation, reward, _, _, info = env.step(action)
    np.testing.assert_array_equal(observation.reshape(4, -1), step.observation[0])
    assert reward == step.reward[0]
    assert sum(value for name, value in info.items() if name.startswith("reward_")) == pytest.approx(reward)


@pytest.mark.skipif(gl.working_backend() is None, reason=f"no OpenGL: {gl.INSTALL_COMMAND}")
def test_pictures_show_what_has_changed():
    env = gymnasium.make(f"hipg/{TASK}-v1", render_mode="rgb_array")
    env.reset(seed=0)
    first = env.render()
    for _ in range(5):
        env.step(env.action_space.sample())
    later = env.render()
    assert first.dtype == later.dtype == np.uint8
    assert first.shape == later.shape == (360, 640, 3)
    assert np.abs(first.astype(int) - later).max() > 50
    np.testing.assert_array_equal(env.render(), later)
    env.close()


# vectors

MODES = pytest.mark.parametrize("mode", list(AutoresetMode))


def told(actions, envs, mode):
    """All that a vector environment says over some steps; ended worlds are reset where it does not."""
    out = [envs.reset(seed=4)]
    for action in actions:
        out.append(envs.step(action))
        done = out[-1][2] | out[-1][3]
        if mode is AutoresetMode.DISABLED and done.any():
            out.append(envs.reset(options={"reset_mask": done}))
    return out


@MODES
@pytest.mark.parametrize("task", ["hazard_nav-4", "multiwalker-3", "paper_nav-4"])
def test_one_world_says_what_gymnasiums_own_vector_environment_says(task, mode):
    numbers = {**(DEADLY if task == TASK else {}), "horizon": 12}
    ours = gymnasium.make_vec(f"hipg/{task}-v1", 1, autoreset_mode=mode, **numbers)
    theirs = SyncVectorEnv([lambda: HipgEnv(task, **numbers)], autoreset_mode=mode)
    assert ours.action_space == theirs.action_space
    assert ours.observation_space == theirs.observation_space
    assert ours.single_action_space == theirs.single_action_space
    assert ours.single_observation_space == theirs.single_observation_space
    assert ours.metadata["autoreset_mode"] is mode
    world = hipg_bench.make(task, 1)
    actions = drawn(world, 0, 40).reshape(40, 1, -1)
    said = told(actions, ours, mode)
    assert sum(bool(entry[3].any()) for entry in said if len(entry) == 5) >= 3
    assert task != TASK or not all(entry[-1]["alive"].all() for entry in said)
    for mine, other in zip(said, told(actions, theirs, mode), strict=True):
        assert data_equivalence(mine, other, exact=True)


class Alone:
    """B worlds one by one, each with an environment of its own: the plain reading of the three modes."""

    def __init__(self, count, mode, task, **numbers):
        self.worlds = [hipg_bench.make(task, 1, seed=4, autoreset=False, **numbers) for _ in range(count)]
        self.mode, self.begun, self.ended = mode, 0, [False] * count
        self.now = [self.begin(world) for world in self.worlds]

    def begin(self, world):
        self.begun += 1
        return world.reset(np.array([self.begun - 1]))

    def step(self, actions):
        was = list(self.ended)
        steps = []
        for b, world in enumerate(self.worlds):
            if was[b] and self.mode is not AutoresetMode.SAME_STEP:
                self.now[b] = self.begin(world)
                was[b] = self.mode is AutoresetMode.NEXT_STEP
            else:
                was[b] = False
            steps.append(self.now[b] if was[b] else world.step(actions[b].reshape(1, world.num_agents, -1)))
        self.now = list(steps)
        self.ended = [bool(step.terminated[0] or step.truncated[0]) for step in steps]
        if self.mode is AutoresetMode.SAME_STEP:
            for b in np.flatnonzero(self.ended):
                self.now[b] = self.begin(self.worlds[b])
        return steps


@MODES
def test_many_worlds_say_what_each_says_alone(mode):
    """Walkers fall at different times: some worlds begin or wait while others go on."""
    count, numbers = 4, {"horizon": 70}
    alone = Alone(count, mode, "multiwalker-3", **numbers)
    envs = HipgVectorEnv("multiwalker-3", count, mode, seed=4, **numbers)
    observation, info = envs.reset()
    actions = drawn(alone.worlds[0], 0, 180 * count).reshape(180, count, -1)
    for action in actions:
        np.testing.assert_array_equal(observation, np.concatenate([flat(now) for now in alone.now]))
        np.testing.assert_array_equal(info["state"], np.concatenate([now.info["state"] for now in alone.now]))
        if mode is AutoresetMode.DISABLED and any(alone.ended):
            envs.reset(options={"reset_mask": np.array(alone.ended)})
        observation, reward, terminated, truncated, info = envs.step(action)
        steps = alone.step(action)
        np.testing.assert_array_equal(reward, [step.reward[0] for step in steps])
        np.testing.assert_array_equal(terminated, [step.terminated[0] for step in steps])
        np.testing.assert_array_equal(truncated, [step.truncated[0] for step in steps])
        ended = terminated | truncated
        assert ("final_obs" in info) == (mode is AutoresetMode.SAME_STEP and ended.any())
        if "final_obs" in info:
            np.testing.assert_array_equal(info["_final_obs"], ended)
            for b, final in enumerate(info["final_obs"]):
                assert (final is None) == (not ended[b])
                assert final is None or np.array_equal(final, flat(steps[b])[0])
    assert alone.begun > 2 * count


def flat(step):
    return step.observation.reshape(1, -1)


@MODES
def test_actions_for_worlds_that_begin_are_ignored_and_those_for_others_are_not(mode):
    envs = HipgVectorEnv(TASK, 2, mode, horizon=3)
    envs.reset(seed=0)
    for _ in range(3):
        *_, truncated, _ = envs.step(np.zeros((2, 12), np.float32))
    assert truncated.all()
    if mode is AutoresetMode.NEXT_STEP:
        envs.step(np.full((2, 12), np.nan, np.float32))
    elif mode is AutoresetMode.DISABLED:
        envs.reset(options={"reset_mask": truncated})
    with pytest.raises(ValueError, match="finite actions are allowed, got nan for env 0, agent 0"):
        envs.step(np.full((2, 12), np.nan, np.float32))


def test_seeds_are_for_whole_episodes_and_resets_without_one_go_on():
    envs = HipgVectorEnv(TASK, 3, "SameStep")
    first, _ = envs.reset(seed=11)
    second, _ = envs.reset()
    envs.step(envs.action_space.sample())
    np.testing.assert_array_equal(envs.reset(seed=11)[0], first)
    np.testing.assert_array_equal(envs.reset()[0], second)
    assert not np.array_equal(first, second)


def test_gymnasiums_vector_wrappers_work_on_ours():
    envs = RecordEpisodeStatistics(HipgVectorEnv(TASK, 3, "SameStep", horizon=4))
    envs.reset(seed=0)
    rewards = []
    for _ in range(4):
        _, reward, _, _, info = envs.step(np.zeros((3, 12), np.float32))
        rewards.append(reward)
    np.testing.assert_allclose(info["episode"]["r"], np.sum(rewards, axis=0))
    listed = DictInfoToList(HipgVectorEnv(TASK, 3, "SameStep", horizon=1))
    listed.reset(seed=0)
    *_, infos = listed.step(np.zeros((3, 12), np.float32))
    assert [info["final_obs"].shape for info in infos] == [listed.single_observation_space.shape] * 3


@pytest.mark.parametrize("mask", [[True, False], np.ones(3, bool), np.ones(2)], ids=["list", "size", "kind"])
def test_another_mask_is_refused(mask):
    envs = HipgVectorEnv(TASK, 2, "Disabled")
    envs.reset(seed=0)
    with pytest.raises(hipg_bench.errors.HipgError, match=r"hazard_nav-4: a bool array of shape \(2,\)"):
        envs.reset(options={"reset_mask": mask})


def test_an_unknown_mode_is_refused_with_the_nearest():
    with pytest.raises(hipg_bench.errors.SpecError, match=re.escape("did you mean 'NextStep'?")):
        HipgVectorEnv(TASK, 2, "nextstep")
