"""Stable-Baselines3: many worlds as slots, ends at different times, its wrappers and its own checks."""

import warnings

import numpy as np
import pytest
from stable_baselines3 import PPO
from stable_baselines3.common.env_checker import check_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecMonitor, VecNormalize

import hipg_bench
from hipg_bench.adapters.gymnasium import HipgEnv
from hipg_bench.adapters.sb3 import HipgVecEnv
from hipg_bench.errors import ActionError, HipgError

DEADLY = {"hazard_peak": 0.5, "hazard_radius": 2.0, "horizon": 6}
WORLDS = 8


def test_slots_are_agents_of_worlds_that_end_and_begin_each_at_its_own_time():
    env = HipgVecEnv("hazard_nav-4", WORLDS, seed=2, **DEADLY)
    alone = [hipg_bench.make("hazard_nav-4", 1, 2, autoreset=False, **DEADLY) for _ in range(WORLDS)]
    now = [world.reset(np.array([b])) for b, world in enumerate(alone)]
    begun, lost, late = WORLDS, 0, 0
    np.testing.assert_array_equal(env.reset(), np.concatenate([step.observation[0] for step in now]))
    chance = np.random.default_rng(0)
    for _ in range(30):
        action = chance.uniform(-1, 1, (WORLDS * 4, 3)).astype(np.float32)
        observation, reward, done, infos = env.step(action)
        assert [info["TimeLimit.truncated"] for info in infos] == [False] * 32 or done.any()
        for b, world in enumerate(alone):
            lived, slots = now[b].info["alive"][0], slice(4 * b, 4 * b + 4)
            now[b] = step = world.step(action[None, slots])
            dead = not step.info["alive"].any()
            over = bool(step.truncated[0]) or dead
            np.testing.assert_array_equal(reward[slots], np.float32(step.reward[0]) * lived)
            np.testing.assert_array_equal(done[slots], over)
            for i, info in enumerate(infos[slots]):
                assert info["alive"] == step.info["alive"][0, i]
                assert info["TimeLimit.truncated"] == (over and not dead)
                assert ("terminal_observation" in info) == over
                if over:
                    np.testing.assert_array_equal(info["terminal_observation"], step.observation[0, i])
            if over:
                now[b] = world.reset(np.array([begun]))
                begun, lost, late = begun + 1, lost + dead, late + (not dead)
            np.testing.assert_array_equal(observation[slots], now[b].observation[0])
    assert lost > 5
    assert late > 5


def test_a_seed_is_for_the_next_reset_only():
    env = HipgVecEnv("coop_nav-3", 2)
    env.seed(9)
    first = env.reset()
    np.testing.assert_array_equal(
        first, hipg_bench.make("coop_nav-3", 2, 9).reset().observation.reshape(6, -1)
    )
    second = env.reset()
    assert not np.array_equal(first, second)
    env.seed(9)
    np.testing.assert_array_equal(env.reset(), first)
    np.testing.assert_array_equal(env.reset(), second)


def test_the_team_as_one_agent_passes_the_librarys_check():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(HipgEnv("hazard_nav-4"))


def test_ppo_learns_and_is_evaluated_through_the_usual_wrappers():
    env = VecNormalize(VecMonitor(HipgVecEnv("hazard_nav-4", 4, **DEADLY)))
    model = PPO("MlpPolicy", env, n_steps=16, batch_size=64, n_epochs=2, seed=0)
    before = [value.detach().clone() for value in model.policy.parameters()]
    model.learn(512)
    after = list(model.policy.parameters())
    assert any((a != b).any() for a, b in zip(after, before, strict=True))
    assert all(value.isfinite().all() for value in after)
    mean, _ = evaluate_policy(model, VecMonitor(HipgVecEnv("hazard_nav-4", 2)), n_eval_episodes=8)
    # at worst 4 points are 2 m from everyone in 50 steps
    assert -150 < mean < 0
    assert env.get_attr("render_mode", [0, 1]) == [None, None]
    assert env.env_is_wrapped(VecMonitor) == [False] * 16


def test_a_wrong_shape_is_refused_with_the_right_one():
    env = HipgVecEnv("hazard_nav-4", 2)
    env.reset()
    with pytest.raises(
        ActionError, match=r"hazard_nav-4: numbers of shape \(8, 3\) are allowed \(B \* N, A\)"
    ):
        env.step(np.zeros((2, 12)))


def test_errors_name_the_world_and_the_agent():
    env = HipgVecEnv("hazard_nav-4", 2)
    action = np.zeros((8, 3), np.float32)
    with pytest.raises(HipgError, match=r"hazard_nav-4: step\(\) before reset\(\)"):
        env.step(action)
    env.reset()
    action[6, 1] = np.nan
    with pytest.raises(ActionError, match=r"hazard_nav-4: .* got nan for env 1, agent 2 \(thrust\[1\]\)"):
        env.step(action)
    env.close()
    with pytest.raises(HipgError, match="hazard_nav-4: this environment is closed"):
        env.reset()
