"""What libraries' networks do is what their policy files do."""

import numpy as np
import pytest
import torch
from stable_baselines3 import A2C, PPO, SAC, TD3
from stable_baselines3.common.vec_env import VecNormalize
from torch import nn

from hipg_bench.adapters.sb3 import HipgVecEnv
from hipg_bench.errors import BundleError
from hipg_bench.policies.export import export_recurrent, export_sb3, export_sequential
from hipg_bench.policies.network import load_network

ALIVE = np.ones((5, 4), bool)


def acted(path, observation):
    policy = load_network(path)
    return policy.act(observation, policy.initial_state(0, np.arange(5), 4), ALIVE)[0]


@pytest.mark.parametrize(("method", "spread"), [(PPO, 1.0), (A2C, 0.0), (SAC, 1.0), (TD3, 0.0)])
def test_sb3_acts_as_its_file(tmp_path, method, spread):
    """Untrained, since any weights will do; with statistics of a few steps where ``spread`` asks for them."""
    worlds = HipgVecEnv("hazard_nav-4", num_envs=5)
    if spread:
        worlds = VecNormalize(worlds)
    model = method("MlpPolicy", worlds, seed=0, policy_kwargs={"net_arch": [16, 16]})
    observation = worlds.reset()
    for _ in range(5 * int(spread)):
        observation, *_ = worlds.step(model.predict(observation)[0])
    with torch.no_grad():
        for name, tensor in model.policy.named_parameters():
            if "action_net" in name or ".mu" in name:
                tensor.mul_(5.0)  # actions that reach the borders
    expected = model.predict(observation, deterministic=True)[0].reshape(5, 4, 3)
    raw = worlds.get_original_obs() if spread else observation
    export_sb3(model, tmp_path / "seed0.safetensors")
    actual = acted(tmp_path / "seed0.safetensors", raw.reshape(5, 4, -1))
    assert expected.std() > 0.01
    np.testing.assert_allclose(actual, expected, atol=1e-4)


def test_sb3_with_another_clip_is_refused(tmp_path):
    worlds = VecNormalize(HipgVecEnv("hazard_nav-4"), clip_obs=5.0)
    with pytest.raises(BundleError, match=r"VecNormalize\(clip_obs=10\) is allowed, got 5"):
        export_sb3(PPO("MlpPolicy", worlds), tmp_path / "x")


class Statistics:
    mean, var = np.linspace(-1, 1, 6), np.linspace(0.5, 3, 6)


SEEN = np.random.default_rng(0).normal(0, 2, (5, 4, 6)).astype(np.float32)


@pytest.mark.parametrize("squash", [[], [nn.Tanh()]], ids=["cut", "squashed"])
@pytest.mark.parametrize("normaliser", [None, Statistics()], ids=["raw", "normalised"])
def test_a_sequence_acts_as_its_file(tmp_path, squash, normaliser):
    torch.manual_seed(0)
    actor = nn.Sequential(nn.Flatten(-1), nn.Linear(6, 8), nn.ReLU(), nn.Linear(8, 3, bias=False), *squash)
    export_sequential(actor, tmp_path / "x", normaliser, epsilon=0.0)
    seen = SEEN if normaliser is None else (SEEN - Statistics.mean) / np.sqrt(Statistics.var)
    with torch.no_grad():
        expected = actor[1:](torch.tensor(seen, dtype=torch.float32)).clamp(-1, 1).numpy()
    np.testing.assert_allclose(acted(tmp_path / "x", SEEN), expected, atol=1e-4)


@pytest.mark.parametrize(
    "encoder", [None, nn.Sequential(nn.Linear(6, 7), nn.ReLU())], ids=["bare", "encoded"]
)
def test_a_recurrent_network_acts_as_its_file(tmp_path, encoder):
    unit, actor = nn.GRUCell(6 if encoder is None else 7, 5), nn.Sequential(nn.Linear(5, 3), nn.Tanh())
    export_recurrent(encoder, unit, actor, tmp_path / "x")
    policy = load_network(tmp_path / "x")
    memory, hidden = policy.initial_state(0, np.arange(5), 4), torch.zeros(20, 5)
    for _ in range(3):
        action, memory = policy.act(SEEN, memory, ALIVE)
        with torch.no_grad():
            seen = torch.tensor(SEEN.reshape(20, 6))
            hidden = unit(seen if encoder is None else encoder(seen), hidden)
            np.testing.assert_allclose(action, actor(hidden).reshape(5, 4, 3).numpy(), atol=1e-4)


@pytest.mark.parametrize(
    "actor",
    [
        nn.Sequential(nn.Linear(6, 8), nn.GELU(), nn.Linear(8, 3)),
        nn.Sequential(nn.Linear(6, 8), nn.Tanh(), nn.Linear(8, 8), nn.ReLU(), nn.Linear(8, 3)),
        nn.Sequential(nn.Linear(6, 8), nn.ReLU()),
        nn.Sequential(nn.LayerNorm(6), nn.Linear(6, 3)),
        nn.Sequential(nn.Linear(6, 8), nn.Linear(8, 3)),
    ],
)
def test_other_networks_are_refused(tmp_path, actor):
    with pytest.raises(
        BundleError, match=r"Linear layers with Tanh or with ReLU .*export other networks as ONNX"
    ):
        export_sequential(actor, tmp_path / "x")
    assert not (tmp_path / "x").exists()


def test_an_activation_may_be_used_twice(tmp_path):
    tanh = nn.Tanh()
    actor = nn.Sequential(nn.Sequential(nn.Linear(6, 8), tanh), nn.Linear(8, 8), tanh, nn.Linear(8, 3))
    export_sequential(actor, tmp_path / "x")
    with torch.no_grad():
        expected = actor(torch.tensor(SEEN)).clamp(-1, 1).numpy()
    np.testing.assert_allclose(acted(tmp_path / "x", SEEN), expected, atol=1e-4)


def test_other_recurrent_networks_are_refused(tmp_path):
    actor = nn.Sequential(nn.Linear(5, 4), nn.Tanh(), nn.Linear(4, 3))
    with pytest.raises(BundleError, match="one layer in one direction"):
        export_recurrent(None, nn.GRU(6, 5, num_layers=2), actor, tmp_path / "x")
    with pytest.raises(BundleError, match="one activation is allowed, got relu and tanh"):
        export_recurrent(nn.Sequential(nn.Linear(6, 6), nn.ReLU()), nn.GRU(6, 5), actor, tmp_path / "x")
    with pytest.raises(BundleError, match="Linear layers with Tanh or with ReLU"):
        export_recurrent(nn.Sequential(nn.Linear(6, 6)), nn.GRU(6, 5), actor, tmp_path / "x")


def test_statistics_of_another_size_are_refused(tmp_path):
    with pytest.raises(BundleError, match=r"the normaliser is of \(6,\), the network takes in \(7,\)"):
        export_sequential(nn.Sequential(nn.Linear(7, 3)), tmp_path / "x", Statistics())
