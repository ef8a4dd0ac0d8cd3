"""The audit's true counterfactuals, against plain loops and cases whose answer is known."""

import json
import math
import shutil
from pathlib import Path

import imageio.v3 as imageio
import numpy as np
import pytest
import torch
from typer.testing import CliRunner

from hipg_bench import make
from hipg_bench.cli import app
from hipg_bench.errors import HipgError, SpecError
from hipg_bench.learning import audit
from hipg_bench.learning.gradient_noise import gradient_noise
from hipg_bench.learning.mappo import Trainer, networks
from hipg_bench.learning.run import train
from hipg_bench.learning.settings import Settings, recommended

SMALL = {"num_envs": 8, "rollout": 10, "steps": 80, "actor_hidden": (16,), "critic_hidden": (16,)}


def quiet(settings: Settings) -> tuple[torch.nn.Module, torch.nn.Module]:
    """Networks whose policy hardly explores."""
    torch.manual_seed(3)
    actor, critic = networks(
        settings, make(settings.task).layout, clips=make(settings.task).spec.clip_actions
    )
    with torch.no_grad():
        actor.log_std.fill_(math.log(1e-6))
    return actor, critic


def test_comparison_by_hand() -> None:
    # learned - true: 1, 1, -1: mean 1/3, root mean square 1; both sides (1,2,0), (0,1,1):
    # deviations (0,1,-1) and (-2/3,1/3,1/3): covariance 0
    found = audit.Comparison(np.array([1.0, 2.0, 0.0]), np.array([0.0, 1.0, 1.0]), 0.0)
    assert found.bias == pytest.approx(1 / 3)
    assert found.error == pytest.approx(1.0)
    assert found.correlation == pytest.approx(0.0, abs=1e-12)


def test_true_returns_are_those_of_a_plain_loop() -> None:
    settings = recommended("coop_nav-3", gamma=0.9, bootstrap_truncation=False)
    actor, _ = quiet(settings)
    env = make("coop_nav-3", 3, seed=5)
    step = env.reset()
    for _ in range(7):
        step = env.step(np.zeros((3, 3, 3)))
    rows = env.rows
    mean, noise = audit._true(actor, settings, rows, 2, np.random.default_rng(0))
    total = np.zeros(3)
    for k in range(env.spec.horizon - 7):
        if 0.9**k < 0.01:
            break
        action = actor(torch.from_numpy(step.observation)).mean.detach().numpy()
        step = env.step(action)
        total += 0.9**k * step.reward
    np.testing.assert_allclose(mean, total, rtol=1e-3)
    assert noise < 1e-3, "nothing but exploration differs between the repeats"


def test_the_dead_are_dead_in_the_true_counterfactual() -> None:
    """All dead from the start: every point is charged the full distance, whatever the drones do."""
    settings = recommended("hazard_nav-4", gamma=0.9, bootstrap_truncation=False)
    actor, _ = quiet(settings)
    env = make("hazard_nav-4", 2, seed=5)
    env.reset()
    rows = env.fork(env.rows, dict.fromkeys(range(4), 0.0))
    mean, _ = audit._true(actor, settings, rows, 2, np.random.default_rng(0))
    # sum of 0.9^k while it is at least 0.01 (k <= 43), times the charge of a point nobody watches
    nobody = float(env.spec.params["uncovered_distance"]) * env.spec.weights["distance"]
    np.testing.assert_allclose(mean, nobody * sum(0.9**k for k in range(44)), rtol=1e-6)


def test_thresholds_are_drawn_again_for_every_repeat() -> None:
    """A drone that stays in a deadly place dies in some repeats and lives in others."""
    settings = recommended("hazard_nav-4", bootstrap_truncation=False)
    env = make("hazard_nav-4", 1, seed=1, hazard_radius=3.0, hazard_peak=0.02)
    env.reset()
    rows = np.repeat(env.rows, 400, axis=0)
    redrawn = audit.redraw_thresholds(env, rows, np.random.default_rng(0))
    threshold = env.get_field("hazard_threshold", redrawn)
    assert np.unique(threshold[:, 0]).size == 400
    # exponential again: mean 1 above the hazard so far
    assert abs((threshold - env.get_field("cumulative_hazard", rows)).mean() - 1) < 0.1
    assert (env.get_field("hazard_threshold", rows) == env.get_field("hazard_threshold", rows[:1])).all()
    assert settings.task == env.spec.task


def test_an_audit_of_a_run(tmp_path: Path) -> None:
    train(recommended("hazard_nav-4", **SMALL), tmp_path, command="test")
    found = audit.audit(*audit.load(tmp_path), worlds=4, moments=2, repeats=2)
    assert found.dead_share.sum() == pytest.approx(1.0)
    assert found.cases <= 4 * 2 * 4
    assert len(found.credit.learned) == found.cases
    with pytest.raises(HipgError, match="not there"):
        audit.load(tmp_path / "nowhere")


def test_the_command_prints_what_it_found_and_draws_it(tmp_path: Path) -> None:
    train(recommended("hazard_nav-4", **SMALL), tmp_path, command="test")
    size = ["--worlds", "4", "--moments", "2", "--repeats", "2"]
    done = CliRunner().invoke(
        app, ["audit", "--run", str(tmp_path), *size, "--plot", str(tmp_path / "a.png")]
    )
    assert done.exit_code == 0, done.output
    assert "credit" in done.stdout
    assert imageio.imread(tmp_path / "a.png").std() > 0
    facts = json.loads(CliRunner().invoke(app, ["audit", "--run", str(tmp_path), *size, "--json"]).stdout)
    found = audit.audit(*audit.load(tmp_path), worlds=4, moments=2, repeats=2)
    assert facts["credit"]["bias"] == pytest.approx(found.credit.bias, abs=1e-6)
    assert facts["gradient"]["episodes"] == 8 * 4
    assert facts["gradient"]["noise"]["central"] == 1.0
    assert "V(s)'s noise" in done.stdout


def test_a_bundle_is_audited_as_its_run(tmp_path: Path) -> None:
    """The critic that lies beside committed weights is the run's own, bit for bit."""
    train(recommended("hazard_nav-4", **SMALL), tmp_path / "run", command="test")
    learner = tmp_path / "run" / "learner.safetensors"
    for ours, theirs in zip(audit.load(tmp_path / "run")[:2], audit.load(learner)[:2], strict=True):
        tensors = theirs.state_dict()
        assert all(torch.equal(tensor, tensors[name]) for name, tensor in ours.state_dict().items())
    bundle = tmp_path / "mine"
    (bundle / "hazard_nav-4").mkdir(parents=True)
    (bundle / "agent.toml").write_text('name = "mine"\nsummary = "a test"\nkind = "network"\n')
    shutil.copy(learner, bundle / "hazard_nav-4" / "seed0.learner.safetensors")
    size = ["--worlds", "4", "--moments", "2", "--repeats", "2", "--json"]
    of_run, of_bundle = (
        json.loads(CliRunner().invoke(app, ["audit", *which, *size]).stdout)
        for which in (["--run", str(tmp_path / "run")], ["--agent", str(bundle), "--task", "hazard_nav-4"])
    )
    assert {**of_run, "run": ""} == {**of_bundle, "run": ""}
    missing = ["audit", "--agent", str(bundle), "--task", "hazard_nav-4", "--seed", "3"]
    with pytest.raises(HipgError, match=r"seed 3; there are: hazard_nav-4/seed0"):
        CliRunner().invoke(app, missing, catch_exceptions=False)
    with pytest.raises(SpecError, match="either"):
        CliRunner().invoke(app, ["audit"], catch_exceptions=False)


@pytest.mark.parametrize("content", [b"not a file of tensors", b""])
def test_a_file_that_holds_no_networks_is_refused(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "learner.safetensors").write_bytes(content)
    with pytest.raises(HipgError, match="cannot be read"):
        audit.load(tmp_path / "learner.safetensors")


def test_a_critic_of_each_ones_own_cannot_be_asked(tmp_path: Path) -> None:
    train(recommended("coop_nav-3", algorithm="local", **SMALL), tmp_path, command="test")
    with pytest.raises(HipgError, match="critic of the joint state"):
        audit.load(tmp_path / "learner.safetensors")


def test_the_gradients_noise_is_that_of_a_plain_loop() -> None:
    """Without a baseline the weight is the target minus its mean: the covariance's trace, by NumPy."""
    settings = recommended("hazard_nav-4", actor_hidden=(8,), attention_groups=(), critic_hidden=(8,))
    torch.manual_seed(1)
    actor, critic = networks(
        settings, make(settings.task).layout, clips=make(settings.task).spec.clip_actions
    )
    found = gradient_noise(actor, critic, settings, worlds=6, seed=500)

    trainer = Trainer(settings.model_copy(update={"num_envs": 6, "rollout": 50, "seed": 500}))
    trainer.actor.load_state_dict(actor.state_dict())
    trainer.critic.load_state_dict(critic.state_dict())
    data = trainer.roll_out()
    with torch.no_grad():
        inputs = trainer.credit_inputs(data)
    value, target = inputs.value, inputs.target
    live = data.health > 0
    traces = []
    for baseline in (torch.zeros_like(value), value):
        psi = (target - baseline).expand(live.shape)
        mean, gradients = float(psi[live].mean()), []
        for b in range(6):
            trainer.actor.zero_grad()
            for t in range(50):
                for i in range(4):
                    if live[t, b, i]:
                        policy = trainer.actor(data.observation[t, b, i])
                        weight = data.health[t, b, i] * float(target[t, b, 0] - baseline[t, b, 0]) - mean
                        (weight * policy.log_prob(data.action[t, b, i]).sum()).backward()
            gradients.append(torch.cat([p.grad.flatten() for p in trainer.actor.parameters()]).numpy())
        traces.append(np.trace(np.cov(np.array(gradients, np.float64).T)))
    assert found.noise["none"] == pytest.approx(traces[0] / traces[1], rel=1e-3)


def test_a_baseline_that_says_the_same_of_all_states_changes_nothing() -> None:
    settings = recommended("coop_nav-3", actor_hidden=(8,), critic_hidden=(8,))
    actor, critic = networks(
        settings, make(settings.task).layout, clips=make(settings.task).spec.clip_actions
    )
    with torch.no_grad():
        for parameter in critic.parameters():
            parameter.zero_()
    found = gradient_noise(actor, critic, settings, worlds=8)
    for name, (low, high) in found.interval.items():
        assert found.noise[name] == pytest.approx(1.0, abs=1e-4)
        assert low == pytest.approx(1.0, abs=1e-4)
        assert high == pytest.approx(1.0, abs=1e-4)
