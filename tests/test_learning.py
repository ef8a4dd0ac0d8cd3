"""The learner's mathematics by hand, and runs that go on as if never stopped."""

import copy
import csv
import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch

from hipg_bench import make
from hipg_bench.errors import BundleError, ResumeError, SpecError
from hipg_bench.learning.credit import normalized
from hipg_bench.learning.credit.min_health import value_without_each, with_each_dead
from hipg_bench.learning.gae import gae
from hipg_bench.learning.losses import surrogate, value_loss
from hipg_bench.learning.mappo import Trainer
from hipg_bench.learning.networks import RunningNorm, Tanh
from hipg_bench.learning.run import train
from hipg_bench.learning.settings import CREDIT_RULES, PRESETS, paper, recommended
from hipg_bench.policies.network import load_network

SMALL = {
    "num_envs": 8, "rollout": 10, "steps": 8 * 10 * 4, "actor_hidden": (16,), "critic_hidden": (16,),
    "eval_every": 2 * 80,
}  # fmt: skip


def column(*values: float) -> torch.Tensor:
    """One world's values over time, (T, 1)."""
    return torch.tensor([float(value) for value in values])[:, None]


def test_gae_by_hand() -> None:
    # gamma = gae_lambda = 0.5; step 1 truncates, step 2 terminates
    # delta0 = 1 + .5*2 - 1   = 1     next_value[0] = V(s1) = 2
    # delta1 = 1 + .5*4 - 2   = 1     truncation bootstraps from the final state's V = 4
    # delta2 = 1 + 0    - 3   = -2    termination does not
    # A2 = -2; A1 = 1 (the sum is cut); A0 = 1 + .25 * A1 = 1.25
    advantage = gae(
        reward=column(1, 1, 1),
        value=column(1, 2, 3),
        next_value=column(2, 4, 100),
        terminated=column(0, 0, 1).bool(),
        done=column(0, 1, 1).bool(),
        gamma=0.5,
        gae_lambda=0.5,
    )
    torch.testing.assert_close(advantage, column(1.25, 1, -2))


def test_gae_with_lambda_one_is_return_minus_value() -> None:
    rng = torch.Generator().manual_seed(0)
    reward, value = torch.randn(12, 3, generator=rng), torch.randn(12, 3, generator=rng)
    last = torch.randn(3, generator=rng)
    never = torch.zeros(12, 3, dtype=torch.bool)
    got = gae(reward, value, torch.cat([value[1:], last[None]]), never, never, 0.9, 1.0)
    # plain sum of discounted rewards plus the discounted last value
    for b in range(3):
        for t in range(12):
            steps = [0.9 ** (k - t) * float(reward[k, b]) for k in range(t, 12)]
            expected = sum(steps) + 0.9 ** (12 - t) * float(last[b]) - float(value[t, b])
            assert float(got[t, b]) == pytest.approx(expected, abs=1e-5)


def test_value_clip_by_hand() -> None:
    # before 0, reach 1: value 3 aiming at 5: (3-5)^2 = 4 against (1-5)^2 = 16 -> 16, and no gradient;
    # value 0.5 aiming at 5 is within reach: 4.5^2 = 20.25, gradient 2 * (0.5 - 5) / 2 samples = -4.5
    value = torch.tensor([3.0, 0.5], requires_grad=True)
    loss = value_loss(value, torch.zeros(2), torch.tensor([5.0, 5.0]), 1.0)
    assert float(loss.detach()) == pytest.approx((16 + 20.25) / 2)
    loss.backward()
    torch.testing.assert_close(value.grad, torch.tensor([0.0, -4.5]))


@pytest.mark.parametrize("dead_value", [0.0, 1.0])
def test_counterfactual_states_change_one_health_only(dead_value: float) -> None:
    state = torch.arange(10.0)[None].repeat(2, 1)
    columns = np.array([3, 7])
    copies = with_each_dead(state, columns, dead_value)
    for agent, own in enumerate(columns.tolist()):
        for name in range(10):
            expected = dead_value if name == own else float(name)
            assert (copies[:, agent, name] == expected).all()


def test_normalisation_ignores_the_dead() -> None:
    psi = torch.tensor([[1.0, 3.0], [1000.0, 5.0]])
    live = torch.tensor([[True, True], [False, True]])
    # live samples 1, 3, 5: mean 3, unbiased deviation 2
    torch.testing.assert_close(normalized(psi, live), torch.tensor([[-1.0, 0.0], [0.0, 1.0]]))


def test_surrogate_by_hand() -> None:
    # ratios 1.5, 1.5, 0.5, 0.5 with clip 0.2 and Psi 1, -1, 1, -1:
    # min(1.5, 1.2) = 1.2; min(-1.5, -1.2) = -1.5; min(.5, .8) = .5; min(-.5, -.8) = -.8 -> mean -0.15
    change = torch.tensor([1.5, 1.5, 0.5, 0.5]).log()
    assert float(surrogate(change, torch.tensor([1.0, -1, 1, -1]), 0.2)) == pytest.approx(-0.15)


def test_min_health_baseline_is_unbiased() -> None:
    """Lemma 1: E[b(s without i) grad log pi] = 0, on states and actions of a real task."""
    torch.manual_seed(0)
    trainer = Trainer(recommended("hazard_nav-4", num_envs=64, rollout=20))
    trainer.iterate()  # values away from zero: a bias would show
    data = trainer.roll_out()
    with torch.no_grad():
        baseline = value_without_each(trainer.credit_inputs(data)).view_as(data.health)
    mean = trainer.actor(data.observation[:-1]).mean
    # grad of log N(a; mu, sigma) with respect to mu is (a - mu) / sigma^2, sampled from the policy itself
    score = (data.action - mean) / trainer.actor.log_std.exp() ** 2
    sample = (data.health * baseline)[..., None] * score
    # one sample per world and step: agents of one world share a state
    per_step = sample.sum(dim=2).flatten(0, 1)
    error = per_step.std(0) / len(per_step) ** 0.5
    assert (per_step.mean(0).abs() < 4 * error).all()
    # it can fail: the same baseline with actions that the policy did not choose is far from zero
    biased = ((data.health * baseline)[..., None] * (score + 1)).sum(dim=2).flatten(0, 1)
    assert (biased.mean(0).abs() > 4 * error).all()


def test_a_dead_agents_sample_has_no_gradient() -> None:
    """Lemma 2, with binary health."""
    trainer = Trainer(recommended("hazard_nav-4", **SMALL))
    data = trainer.roll_out()
    data.health[:, :, 1] = 0.0
    data.observation.requires_grad_(True)
    _, psi = trainer.assign_credit(data)
    policy = trainer.actor(data.observation[:-1])
    change = policy.log_prob(data.action).sum(-1) - data.log_prob
    surrogate(change.flatten(), psi.flatten(), 0.2).backward()
    assert (data.observation.grad[:-1, :, 1] == 0).all()
    assert (data.observation.grad[:-1, :, 0] != 0).any()


def test_running_norm_matches_all_data_at_once() -> None:
    rng = np.random.default_rng(0)
    parts = [rng.normal(5, 3, (n, 4)).astype(np.float32) for n in (50, 300, 7)]
    norm = RunningNorm(4, fixed=np.array([2]))
    for part in parts:
        norm.update(torch.from_numpy(part))
        norm.update(torch.empty(0, 4))  # a step at which nobody was alive
    together = np.concatenate(parts)
    free = [0, 1, 3]
    np.testing.assert_allclose(norm.offset.numpy()[free], together.mean(0)[free], atol=1e-3)
    np.testing.assert_allclose(norm.scale.numpy()[free], together.std(0)[free], rtol=1e-3)
    assert norm.offset[2] == 0
    assert norm.scale[2] == 1


def test_running_norm_treats_slots_alike() -> None:
    rng = np.random.default_rng(0)
    parts = [rng.normal(np.arange(5), 3, (n, 5)).astype(np.float32) for n in (50, 300)]
    norm = RunningNorm(5, shared=[np.array([[1, 2], [3, 4]])])  # two slots of two numbers
    for part in parts:
        norm.update(torch.from_numpy(part))
    together = np.concatenate(parts)
    for entry in (1, 2):
        both = together[:, [entry, entry + 2]]
        np.testing.assert_allclose(norm.offset.numpy()[[entry, entry + 2]], both.mean(), atol=1e-3)
        np.testing.assert_allclose(norm.scale.numpy()[[entry, entry + 2]], both.std(), rtol=1e-3)
    np.testing.assert_allclose(norm.offset[0], together[:, 0].mean(), atol=1e-3)


@pytest.mark.parametrize("attention_groups", [(), ("point", "neighbor"), ("neighbor",)])
def test_numpy_policy_is_the_torch_actor(attention_groups: tuple[str, ...], tmp_path: Path) -> None:
    trainer = Trainer(recommended("hazard_nav-4", attention_groups=attention_groups, **SMALL))
    trainer.iterate()
    trainer.save_policy(tmp_path / "policy.safetensors")
    policy = load_network(tmp_path / "policy.safetensors")
    observation, alive = trainer.step.observation.copy(), trainer.step.info["alive"]
    observation[0, 0, trainer.env.layout.observation.slices["neighbor_seen"]] = 0.0  # nobody is in sight
    action, _ = policy.act(observation, None, alive)
    expected = trainer.actor(torch.from_numpy(observation)).mean.detach().numpy().clip(-1, 1)
    np.testing.assert_allclose(action, expected, atol=2e-5)


def test_the_order_of_an_attended_group_does_not_matter() -> None:
    trainer = Trainer(recommended("hazard_nav-4", **SMALL))
    trainer.iterate()
    slices = trainer.env.layout.observation.slices
    seen = torch.from_numpy(trainer.step.observation)
    turned = seen.clone()
    for name in ("point_position", "point_hazardous", "point_gap"):
        slots = seen[..., slices[name]].unflatten(-1, (4, -1))
        turned[..., slices[name]] = slots.flip(-2).flatten(-2)
    assert not torch.equal(seen, turned)
    torch.testing.assert_close(trainer.actor(turned).mean, trainer.actor(seen).mean, atol=1e-5, rtol=1e-4)


def test_a_resumed_run_is_the_same_run(tmp_path: Path) -> None:
    train(recommended("hazard_nav-4", **SMALL), tmp_path / "whole", command="test")
    train(recommended("hazard_nav-4", **{**SMALL, "steps": 8 * 10 * 2}), tmp_path / "cut", command="test")
    train(recommended("hazard_nav-4", **SMALL), tmp_path / "cut", command="test")
    whole, cut = ((tmp_path / name / "policy.safetensors").read_bytes() for name in ("whole", "cut"))
    assert whole == cut
    rows = [list(csv.DictReader((tmp_path / name / "curve.csv").open())) for name in ("whole", "cut")]
    assert len(rows[0]) == 4
    for a, b in zip(*rows, strict=True):
        assert {**a, "seconds": ""} == {**b, "seconds": ""}
    assert json.loads((tmp_path / "cut" / "train.json").read_text())["env_steps"] == 320


def test_a_larger_team_starts_from_what_a_smaller_one_learned(tmp_path: Path) -> None:
    start = Path("agents/mappo_minhealth/hazard_comm-10/seed0.safetensors").resolve()
    teacher = load_network(start)
    own = recommended(
        "hazard_comm-16", num_envs=8, rollout=10, initial_policy=str(start), critic_hidden=(16,)
    )
    trainer = Trainer(own)
    trainer.start_from_policy(start)
    observation = trainer.step.observation
    expected, _ = teacher.act(observation, None, trainer.step.info["alive"])
    mean = trainer.actor(torch.from_numpy(observation)).mean.detach().numpy()
    np.testing.assert_allclose(mean.clip(-1, 1), expected, atol=2e-5)
    trainer.iterate()
    # what is met, 8 worlds x 10 steps x 16 agents, weighs 1 of 21 parts
    np.testing.assert_allclose(float(trainer.actor.norm.count), 21 * 8 * 10 * 16, rtol=0.05)


def test_a_start_that_does_not_fit_is_refused(tmp_path: Path) -> None:
    other = Path("agents/mappo_minhealth/hazard_nav-8/seed0.safetensors").resolve()
    settings = recommended("hazard_comm-16", num_envs=8, rollout=10, initial_policy=str(other))
    with pytest.raises(BundleError, match="a start must declare"):
        train(settings, tmp_path, command="test")
    assert not (tmp_path / "checkpoint.pt").exists()


def test_a_trial_is_the_plain_loop_over_the_policy_file(tmp_path: Path) -> None:
    """Worlds nobody is trained or scored in, one episode of each, on the task's own scale."""
    train(recommended("hazard_nav-4", **SMALL), tmp_path, command="test")
    rows = list(csv.DictReader((tmp_path / "curve.csv").open()))
    assert [bool(row["score"]) for row in rows] == [False, True, False, True]
    policy, returns = load_network(tmp_path / "policy.safetensors"), list[float]()
    env = make("hazard_nav-4", 1, seed=30_000, threads=1)
    for episode in range(32):
        step, total = env.reset(np.array([episode])), 0.0
        for _ in range(env.spec.horizon):
            action, _ = policy.act(step.observation, None, step.info["alive"])
            step = env.step(action)
            total += float(step.reward[0])
        returns.append(total)
    anchors = env.spec.anchors
    low, high = anchors.random.mean, anchors.reference.mean
    # Student's t with 31 degrees of freedom leaves 2.5 % above 2.0395 (tables)
    half = 2.0395 * np.std(returns, ddof=1) / math.sqrt(32)
    expected = {
        "eval_return": np.mean(returns),
        "score": (np.mean(returns) - low) / (high - low),
        "score_low": (np.mean(returns) - half - low) / (high - low),
        "score_high": (np.mean(returns) + half - low) / (high - low),
    }
    for name, value in expected.items():
        assert float(rows[-1][name]) == pytest.approx(value, rel=1e-4), name


def test_trials_change_nothing_of_the_run(tmp_path: Path) -> None:
    """Nor does how often they are held: a run goes on with another ``eval_every``."""
    train(recommended("hazard_nav-4", **SMALL), tmp_path / "some", command="test")
    often = {**SMALL, "eval_every": 1}
    train(recommended("hazard_nav-4", **{**often, "steps": 160}), tmp_path / "many", command="test")
    train(recommended("hazard_nav-4", **{**often, "eval_every": 0}), tmp_path / "many", command="test")
    some, many = ((tmp_path / name / "policy.safetensors").read_bytes() for name in ("some", "many"))
    assert some == many
    rows = list(csv.DictReader((tmp_path / "many" / "curve.csv").open()))
    assert [bool(row["score"]) for row in rows] == [True, True, False, True]


def test_a_run_from_before_trials_goes_on(tmp_path: Path) -> None:
    """Its checkpoint names no ``eval_every``, its curve has no scores, and no critic lies beside it."""
    train(recommended("hazard_nav-4", **SMALL), tmp_path / "whole", command="test")
    train(recommended("hazard_nav-4", **{**SMALL, "steps": 160}), tmp_path / "old", command="test")
    path = tmp_path / "old" / "checkpoint.pt"
    content = torch.load(path, weights_only=True)
    settings = json.loads(content["settings"])
    del settings["eval_every"]
    torch.save({**content, "settings": json.dumps(settings)}, path)
    curve = tmp_path / "old" / "curve.csv"
    rows = list(csv.DictReader(curve.open()))
    old = [name for name in rows[0] if "score" not in name and name != "eval_return"]
    lines = [",".join(old), *(",".join(row[name] for name in old) for row in rows)]
    curve.write_text("\n".join(lines) + "\n")
    for seal in (tmp_path / "old").glob(".*.sha256"):
        seal.unlink()  # there were none
    (tmp_path / "old" / "learner.safetensors").unlink()
    train(recommended("hazard_nav-4", **SMALL), tmp_path / "old", command="test")
    whole, resumed = ((tmp_path / run / "policy.safetensors").read_bytes() for run in ("whole", "old"))
    assert whole == resumed
    assert (tmp_path / "old" / "learner.safetensors").exists()
    rows = list(csv.DictReader(curve.open()))
    assert len(rows) == 4
    assert rows[-1]["score"]


def test_another_runs_folder_is_refused(tmp_path: Path) -> None:
    train(recommended("hazard_nav-4", **SMALL), tmp_path, command="test")
    with pytest.raises(ResumeError, match="gamma"):
        train(recommended("hazard_nav-4", **SMALL, gamma=0.5), tmp_path, command="test")


@pytest.mark.parametrize(
    ("field", "value"), [("gamma", 1.5), ("algorithm", "min-health"), ("steps", 0), ("seed", 1000)]
)
def test_settings_out_of_range_are_refused(field: str, value: object) -> None:
    with pytest.raises(SpecError, match=field):
        recommended("hazard_nav-4", **{field: value})


def test_learning_pays_off_in_a_minute() -> None:
    """PPO on a task without hazard: returns must rise well beyond the first iterations' noise."""
    trainer = Trainer(recommended("coop_nav-3", num_envs=64, actor_hidden=(64,), critic_hidden=(64,)))
    returns = [trainer.iterate()["return"] for _ in range(12)]
    assert np.mean(returns[-2:]) > np.mean(returns[:2]) + 4


@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize("algorithm", CREDIT_RULES)
def test_every_algorithm_and_preset_improves_both_networks(preset: str, algorithm: str) -> None:
    trainer = Trainer(PRESETS[preset]("paper_nav-4", algorithm=algorithm, **SMALL))
    before = [p.detach().clone() for p in (*trainer.actor.parameters(), *trainer.critic.parameters())]
    log = trainer.iterate()
    assert all(np.isfinite(value) for name, value in log.items() if name != "first_death")
    after = [*trainer.actor.parameters(), *trainer.critic.parameters()]
    assert all((a != b).any() for a, b in zip(before, after, strict=True))


def test_values_are_bootstrapped_from_what_a_step_led_to() -> None:
    """With lambda 0 a value target is r + gamma V(next), one world and step at a time."""
    changes = {**SMALL, "rollout": 60, "gae_lambda": 0.0}
    trainer = Trainer(recommended("hazard_nav-4", **changes))
    steps, step = [], trainer.env.step
    trainer.env.step = lambda action: steps.append(step(action)) or steps[-1]
    data = trainer.roll_out()
    units = copy.deepcopy(trainer.critic.returns.state_dict())
    target, _ = trainer.assign_credit(data)
    trainer.critic.returns.load_state_dict(units)  # what values were in before the targets were taken in
    for t, now in enumerate(steps):
        ended = np.flatnonzero(now.truncated).tolist()
        for b in range(trainer.env.num_envs):
            led_to = now.info["final_state"][ended.index(b)] if b in ended else now.info["state"][b]
            share = data.elapsed[t, b] + 1 / 50
            value = trainer.critic(torch.from_numpy(led_to)[None], share[None]).detach()
            expected = now.reward[b] + trainer.settings.gamma * float(value)
            assert float(target[t, b]) == pytest.approx(expected, abs=1e-3)
    assert len(ended) == 0
    assert any(now.truncated.any() for now in steps)
    assert len(data.ends) == 1


def test_a_local_critic_sees_one_agent_only() -> None:
    trainer = Trainer(recommended("hazard_nav-4", algorithm="local", **SMALL))
    data = trainer.roll_out()
    target, _ = trainer.assign_credit(data)
    assert target.shape == (10, 8, 4)
    seen, elapsed = trainer.critic.views(data)
    value = trainer.critic(seen, elapsed)
    data.observation[:, :, 0] += 1.0
    other = trainer.critic(*trainer.critic.views(data))
    assert (other[:, :, 0] != value[:, :, 0]).any()
    torch.testing.assert_close(other[:, :, 1:], value[:, :, 1:])


def test_dead_samples_move_the_actor_only_where_they_are_not_masked() -> None:
    """What the dead are told to do (their stored actions) changes the update, or does not."""
    ends: dict[bool, list[torch.Tensor]] = {True: [], False: []}
    for masked, moved in ((masked, moved) for masked in ends for moved in (0.0, 0.5)):
        trainer = Trainer(recommended("hazard_nav-4", algorithm="central", mask_dead=masked, **SMALL))
        data = trainer.roll_out()
        data.health[:, :, 1] = 0.0
        target, psi = trainer.assign_credit(data)
        data.action[:, :, 1] += moved
        trainer.update(data, target, psi)
        ends[masked].append(torch.cat([p.detach().flatten() for p in trainer.actor.parameters()]))
    assert torch.equal(*ends[True])
    assert not torch.equal(*ends[False])


def test_the_papers_quirks_are_in_its_preset() -> None:
    settings = paper("paper_nav-8", algorithm="central")
    # facts sheet, section 5: 50,000 episodes of 50 steps, 256 a batch, 8 epochs, 8 minibatches
    assert settings.steps == 50_000 * 50
    assert settings.num_envs * settings.rollout == 256 * 50
    assert (settings.epochs, settings.minibatches, settings.value_clip) == (8, 8, 0.2)
    assert not settings.mask_dead
    assert not settings.bootstrap_truncation
    trainer = Trainer(paper("paper_nav-8", algorithm="local", num_envs=4))
    data = trainer.roll_out()
    trainer.assign_credit(data)
    assert (trainer.actor.norm.scale == 1).all()
    assert (trainer.critic.returns.scale == 1).all()
    assert (data.action[data.health == 0] == 0).all()


def test_fast_tanh_is_tanh() -> None:
    x = torch.linspace(-12, 12, 1001)
    torch.testing.assert_close(Tanh()(x), torch.tanh(x), atol=2e-7, rtol=0)


@pytest.mark.parametrize(("theirs", "ours"), [("mappo", "central"), ("ippo", "local")])
def test_the_fields_names_of_algorithms_are_understood(theirs: str, ours: str) -> None:
    for preset in PRESETS.values():
        assert preset("hazard_nav-4", algorithm=theirs) == preset("hazard_nav-4", algorithm=ours)
