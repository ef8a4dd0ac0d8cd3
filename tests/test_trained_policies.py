"""What is trained, what is stored and what is exported are one policy."""

import os
import subprocess
import sys

import numpy as np
import pytest
import torch

from hipg_bench.learning.mappo import Trainer
from hipg_bench.learning.settings import paper, recommended
from hipg_bench.policies.network import load_network
from hipg_bench.registry import task_spec, tasks

GRID = 2.0**-16


def small_trainer(task, **changes):
    preset = paper if task.startswith("paper") else recommended
    return Trainer(preset(task, num_envs=8, rollout=12, **changes))


def roused(trainer):
    """The trainer, its actions several times as large as any that a task clips at."""
    linears = [one for one in trainer.actor.body.modules() if isinstance(one, torch.nn.Linear)]
    with torch.no_grad():
        linears[-1].weight.mul_(400)
        linears[-1].bias.add_(torch.linspace(-3, 3, len(linears[-1].bias)))
    return trainer


@pytest.mark.parametrize("task", tuple(tasks()))
def test_the_exported_policy_acts_as_the_trained_one(task, tmp_path):
    """On states of a rollout: the mean that exploration is added to, clipped only where the task clips.

    Weights and observations are float32 in training and float64 when exported: 2e-3 is 30 times what such
    sums of some hundred terms of size 10 differ by, and a thousandth of what a wrong clip takes away.
    """
    trainer = roused(small_trainer(task))
    data = trainer.roll_out()
    trainer.update(data, *trainer.assign_credit(data))  # the normaliser has moved too
    data = trainer.roll_out()
    trainer.save_policy(tmp_path / "policy.safetensors")
    exported = load_network(tmp_path / "policy.safetensors")
    largest = 0.0
    with torch.no_grad():
        for t in range(len(data.action)):
            alive = data.health[t].numpy() > 0
            trained = trainer.actor(data.observation[t]).mean.double().numpy()
            if task_spec(task).clip_actions:
                trained = np.clip(trained, -1, 1)
            acted, _ = exported.act(data.observation[t].double().numpy(), None, alive)
            assert np.abs(acted - trained)[alive].max(initial=0) < GRID + 2e-3
            np.testing.assert_array_equal(acted[alive], np.round(acted[alive] / GRID) * GRID)
            largest = max(largest, np.abs(acted[alive]).max(initial=0))
    assert (largest > 2) == (not task_spec(task).clip_actions)


@pytest.mark.parametrize("task", ["hazard_nav-4", "multiwalker_planar-3", "paper_comm-10"])
@pytest.mark.parametrize("warm", [False, True], ids=["from scratch", "warm start"])
def test_the_first_minibatchs_ratio_is_one(task, warm, tmp_path):
    """exp(log pi_new - log pi_old) before any gradient, to the rounding of float32 sums (1e-4)."""
    trainer = small_trainer(task)
    if warm:  # from a policy whose observations had another mean and scale
        other = small_trainer(task, seed=1)
        size = trainer.env.observation_size
        other.actor.norm.adopt(torch.full((size,), 3.0), torch.full((size,), 0.2), 1000)
        other.save_policy(tmp_path / "start.safetensors")
        trainer.start_from_policy(tmp_path / "start.safetensors")
    trainer.iterate()
    data = trainer.roll_out()
    trainer.assign_credit(data)
    with torch.no_grad():
        policy = trainer.actor(data.observation[:-1])
        ratio = (policy.log_prob(data.action).sum(-1) - data.log_prob).exp()
    acted = data.health > 0  # the paper's preset stores zeros as actions of the dead
    assert float((ratio[acted] - 1).abs().max()) < 1e-4


def test_entropy_follows_its_target():
    """The bonus grows while a policy explores less than asked, shrinks while it explores more, is resumed."""
    low = small_trainer("paper_nav-4", target_entropy=-3.0)
    high = small_trainer("paper_nav-4", target_entropy=3.0)
    for trainer, factor in ((low, 1 / 1.1), (high, 1.1)):
        for _ in range(3):
            log = trainer.iterate()
        assert log["entropy_coef"] == pytest.approx(0.01 * factor**3)


def test_the_entropy_bonus_is_in_the_checkpoint(tmp_path):
    trainer = small_trainer("paper_nav-4", target_entropy=3.0)
    trainer.iterate()
    trainer.save(tmp_path / "checkpoint.pt")
    other = small_trainer("paper_nav-4", target_entropy=3.0)
    other.resume(tmp_path / "checkpoint.pt")
    assert other.entropy_coef == trainer.entropy_coef == pytest.approx(0.011)


def test_training_computes_in_single_precision_on_every_processor():
    """A product of 128 terms is within 1e-4 of double precision; with bfloat16 it would be 0.1 off."""
    code = """
import torch
from hipg_bench.learning import torch_setup
torch_setup.configure()
torch.manual_seed(0)
a, b = torch.randn(512, 128), torch.randn(128, 128)
print(float((a @ b - a.double() @ b.double()).abs().max()))
"""
    environment = {name: value for name, value in os.environ.items() if name != "ONEDNN_MAX_CPU_ISA"}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment)
    assert float(done.stdout) < 1e-4, done.stderr
