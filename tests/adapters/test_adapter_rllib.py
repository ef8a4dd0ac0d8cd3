"""The RLlib adapter: RLlib's own view of its episodes, and a real learner. `make test-rllib` runs it."""

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

ray = pytest.importorskip("ray")

from ray.rllib.algorithms.ppo import PPOConfig  # noqa: E402
from ray.rllib.env.multi_agent_env_runner import MultiAgentEnvRunner  # noqa: E402
from ray.rllib.utils.pre_checks.env import check_multiagent_environments  # noqa: E402

import hipg_bench  # noqa: E402
from hipg_bench.adapters.rllib import HipgMultiAgentEnv  # noqa: E402
from hipg_bench.errors import ActionError, HipgError, SpecError, UnknownNameError  # noqa: E402
from hipg_bench.rendering import gl  # noqa: E402

SPREAD = {"hazard_peak": 0.1, "hazard_radius": 2.0}
"""Deaths all along the episode."""
SWIFT = {"hazard_peak": 0.9, "hazard_radius": 3.0}
"""Deaths from the first step on; nobody survives."""
SEED = 4


@pytest.fixture(scope="module", autouse=True)
def cluster():
    ray.init(
        address="local", num_cpus=2, object_store_memory=80_000_000,
        include_dashboard=False, log_to_driver=False,
    )  # fmt: skip
    yield
    ray.shutdown()


def configured(task="hazard_nav-4", copies=1, **overrides):
    return (
        PPOConfig()
        .environment(HipgMultiAgentEnv, env_config={"task": task, **overrides})
        .multi_agent(policies={"team"}, policy_mapping_fn=lambda agent, *_, **__: "team")
        .env_runners(num_env_runners=0, num_envs_per_env_runner=copies)
        .training(train_batch_size_per_learner=200, minibatch_size=100, num_epochs=2)
        .debugging(seed=SEED, log_level="ERROR")
    )


def still(env, agents=None):
    """Zeros for some agents, by default all."""
    return {agent: np.zeros(env.action_spaces[agent].shape) for agent in agents or env.possible_agents}


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("task", hipg_bench.tasks())
def test_rllibs_own_check_is_content_with_every_task(task):
    check_multiagent_environments(HipgMultiAgentEnv({"task": task}))


@pytest.mark.filterwarnings("error")
def test_rllibs_own_check_is_content_where_agents_die_at_once():
    env = HipgMultiAgentEnv({"task": "hazard_nav-8", **SWIFT})
    check_multiagent_environments(env)
    # the check goes as far as this step
    env.reset(seed=42)
    _, _, terminated, _, _ = env.step(still(env))
    assert any(terminated[agent] for agent in env.possible_agents)


def test_spaces_hold_what_is_seen_and_done():
    env = HipgMultiAgentEnv({"task": "hazard_nav-4", **SPREAD})
    observations, _ = env.reset(seed=0)
    while observations:
        for agent, observation in observations.items():
            assert env.observation_spaces[agent].contains(observation)
        acting = {agent: env.action_spaces[agent].sample() for agent in observations}
        observations, rewards, terminated, truncated, infos = env.step(acting)
        assert observations.keys() == rewards.keys() == infos.keys() == terminated.keys() - {"__all__"}
        if terminated["__all__"] or truncated["__all__"]:
            break
        observations = {a: o for a, o in observations.items() if not terminated[a]}


@pytest.mark.parametrize(
    ("task", "overrides"),
    [
        ("hazard_nav-4", SPREAD),
        ("hazard_nav-4", {**SWIFT, "horizon": 20}),
        ("multiwalker-3", {}),
        ("coop_nav-3", {}),
    ],
)
def test_rllib_understands_how_each_agents_episode_ended(task, overrides):
    """Sampled by RLlib's runner, against the same actions in a world of its own."""
    runner = MultiAgentEnvRunner(config=configured(task, **overrides))
    episodes = runner.sample(num_episodes=4, random_actions=True)
    runner.stop()
    env = hipg_bench.make(task, 1, SEED, threads=1, autoreset=False, **overrides)
    ends = []
    for episode in episodes:
        lengths, ended, total = replayed(env, episode)
        assert {agent: len(part) for agent, part in episode.agent_episodes.items()} == lengths
        for agent, part in episode.agent_episodes.items():
            # what RLlib cuts off, and what it bootstraps
            assert part.is_terminated == (ended[agent] == "terminated")
            assert part.is_truncated or part.is_terminated
            np.testing.assert_allclose(part.get_return(), total[agent], rtol=1e-5)
        ends += ended.values()
    assert ("truncated" in ends) == (task != "multiwalker-3" and "horizon" not in overrides)
    assert ("terminated" in ends) == (task != "coop_nav-3")


def replayed(env, episode):
    """Steps each agent took, how it ended and what it was paid, as the world says."""
    step, t = env.reset(), 0
    names = [f"agent_{i}" for i in range(env.num_agents)]
    lengths, ended, total = dict.fromkeys(names, 0), {}, dict.fromkeys(names, 0.0)
    while len(ended) < len(names):
        acting = {a: episode.agent_episodes[a].get_actions(t) for a in names if a not in ended}
        rows = [acting.get(agent, np.zeros(env.action_size)) for agent in names]
        step, t = env.step(np.stack(rows)[None]), t + 1
        for i, agent in enumerate(names):
            if agent in ended:
                continue
            lengths[agent], total[agent] = t, total[agent] + step.reward[0]
            if step.terminated[0] or not step.info["final_alive"][0, i]:
                ended[agent] = "terminated"
            elif step.truncated[0]:
                ended[agent] = "truncated"
    return lengths, ended, total


def test_seeded_copies_play_different_worlds():
    runner = MultiAgentEnvRunner(config=configured(copies=3))
    episodes = runner.sample(num_episodes=3, random_actions=True)
    runner.stop()
    starts = {episode.get_observations(0)["agent_0"].tobytes() for episode in episodes}
    assert len(starts) == 3


def test_unseeded_environments_differ_and_seeded_ones_do_not():
    envs = [HipgMultiAgentEnv({"task": "hazard_nav-4"}) for _ in range(2)]
    a, b = (env.reset()[0]["agent_0"] for env in envs)
    assert (a != b).any()
    a, b = (env.reset(seed=1)[0]["agent_0"] for env in envs)
    np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("task", ["hazard_nav-4", "multiwalker_planar-3"])
def test_ppo_learns_from_teams_that_lose_members(task):
    overrides = SPREAD if task == "hazard_nav-4" else {}
    algorithm = configured(task, copies=4, **overrides).build_algo()
    before = algorithm.get_module("team").get_state()
    for _ in range(3):
        result = algorithm.train()
    after = algorithm.get_module("team").get_state()
    algorithm.stop()
    learner, played = result["learners"]["team"], result["env_runners"]
    assert learner["num_module_steps_trained_lifetime"] > 0
    assert all(np.isfinite(learner[loss]) for loss in ("total_loss", "policy_loss", "vf_loss", "entropy"))
    assert np.isfinite(played["episode_return_mean"])
    assert min(played["agent_steps"].values()) < played["episode_len_mean"]  # somebody died
    assert any((before[name] != after[name]).any() for name in before)


def test_the_example_learns():
    example = Path(__file__).parents[2] / "examples" / "rllib_ppo.py"
    done = subprocess.run(
        [sys.executable, example, "--iterations", "4", "--steps", "2000", "--workers", "1"],
        capture_output=True, text=True, timeout=200,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    returns = [float(number) for number in re.findall(r"return (-?[\d.]+)", done.stdout)]
    assert len(returns) == 4
    assert returns[-1] > returns[0]


def test_pictures():
    if gl.working_backend() is None:
        pytest.skip("no OpenGL works here")
    env = HipgMultiAgentEnv({"task": "hazard_nav-4", "render_mode": "rgb_array"})
    with pytest.raises(HipgError, match="reset"):
        env.render()
    env.reset(seed=0)
    first = env.render()
    env.step({agent: np.ones(3) for agent in env.agents})
    second = env.render()
    env.close()
    assert first.dtype == np.uint8
    assert first.shape == second.shape
    assert (first != second).any()


def test_a_wrong_config_is_explained():
    with pytest.raises(SpecError, match=r"needs a 'task'.*hazard_nav-4"):
        HipgMultiAgentEnv({})
    with pytest.raises(UnknownNameError, match="did you mean 'hazard_nav-4'"):
        HipgMultiAgentEnv({"task": "hazard_nav4"})
    with pytest.raises(SpecError, match="did you mean 'horizon'"):
        HipgMultiAgentEnv({"task": "hazard_nav-4", "horizn": 3})


def test_wrong_use_is_explained():
    env = HipgMultiAgentEnv({"task": "hazard_nav-4", "horizon": 1})
    with pytest.raises(HipgError, match=r"hazard_nav-4: reset\(\) comes first"):
        env.step(still(env))
    env.reset(seed=0)
    with pytest.raises(UnknownNameError, match="agent_9"):
        env.step({**still(env), "agent_9": np.zeros(3)})
    with pytest.raises(ActionError, match="agent_3"):
        env.step(still(env, ["agent_0", "agent_1", "agent_2"]))
    with pytest.raises(ActionError, match=r"agent_2.*\(2,\)"):
        env.step({**still(env), "agent_2": np.zeros(2)})
    with pytest.raises(ActionError, match="agent 1"):
        env.step({**still(env), "agent_1": np.array([0, np.nan, 0])})
    *_, truncated, _ = env.step(still(env))
    assert truncated == {"__all__": True}
    with pytest.raises(HipgError, match=r"reset\(\) comes first"):
        env.step(still(env))
    env.close()
    with pytest.raises(HipgError, match="closed"):
        env.reset()
