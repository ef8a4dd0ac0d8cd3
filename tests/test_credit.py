"""Credit rules by hand-derived numbers and plain loops, and the registry that finds them."""

import dataclasses
import math
import re
from pathlib import Path

import numpy as np
import pytest
import torch

from hipg_bench import make
from hipg_bench.errors import SpecError
from hipg_bench.learning import credit
from hipg_bench.learning.mappo import Trainer
from hipg_bench.learning.run import train
from hipg_bench.learning.settings import CREDIT_RULES, read_settings, recommended, to_toml
from hipg_bench.policies.network import load_network

SMALL = {
    "num_envs": 6,
    "rollout": 10,
    "actor_hidden": (16,),
    "critic_hidden": (16, 16),
    "attention_groups": (),
}


def played(task: str, algorithm: str, **changes) -> tuple[Trainer, credit.CreditInputs]:
    """A trainer and what its rule is given of a first rollout."""
    trainer = Trainer(recommended(task, algorithm=algorithm, **{**SMALL, **changes}))
    data = trainer.roll_out()
    trainer.critic.update_norm(data)
    return trainer, trainer.credit_inputs(data)


def test_central_and_local_credit_by_hand() -> None:
    # one value for the team: 10 - 8; one for each agent: 10 - 8, 10 - 4, 10 - 1
    _, inputs = played("coop_nav-3", "central")
    shared = dataclasses.replace(inputs, target=torch.full((1, 1, 1), 10.0), value=torch.full((1, 1, 1), 8.0))
    assert credit.find("central").psi(shared).tolist() == [[[2.0]]]
    values = torch.tensor([[[8.0, 4.0, 1.0]]])
    own = dataclasses.replace(inputs, target=torch.full((1, 1, 3), 10.0), value=values)
    assert credit.find("local").psi(own).tolist() == [[[2.0, 6.0, 9.0]]]


def test_min_health_credit_asks_the_critic_about_each_death() -> None:
    """Eqn:min_health_baseline_ppo: a critic that counts the living says what each is worth."""
    trainer, inputs = played("hazard_nav-4", "min_health")
    columns = torch.as_tensor(trainer.env.layout.health_columns)

    def living(state, elapsed):
        return 3.0 * state[..., columns].sum(-1)

    trainer.critic.forward = living
    target = living(inputs.data.state[:-1], None)[..., None]
    psi = credit.find("min_health").psi(dataclasses.replace(inputs, target=target))
    # V_targ - V(s without i) = 3 h_i
    torch.testing.assert_close(psi, 3.0 * inputs.data.health)


def test_every_rule_trains_resumes_and_leaves_a_policy(tmp_path: Path) -> None:
    for name in CREDIT_RULES:
        settings = recommended("coop_nav-3", algorithm=name, **{**SMALL, "steps": 180})
        train(settings, tmp_path / name / "whole", command="test")
        first = settings.model_copy(update={"steps": 60})
        train(first, tmp_path / name / "parts", command="test")
        train(settings, tmp_path / name / "parts", command="test")
        whole, parts = (
            load_network(tmp_path / name / run / "policy.safetensors") for run in ("whole", "parts")
        )
        observation = np.random.default_rng(0).normal(size=(2, 3, whole.observation_size))
        alive = np.ones((2, 3), bool)
        action, again = (one.act(observation, None, alive)[0] for one in (whole, parts))
        np.testing.assert_array_equal(action, again)
        assert np.isfinite(action).all()


def test_the_dead_have_no_weight_and_the_living_are_normalised() -> None:
    for name in CREDIT_RULES:
        trainer = Trainer(recommended("hazard_nav-4", algorithm=name, **SMALL))
        data = trainer.roll_out()
        data.health[:, :, 1] = 0.0
        _, psi = trainer.assign_credit(data)
        live = data.health > 0
        assert (psi[~live] == 0).all(), name
        assert abs(float(psi[live].mean())) < 1e-4, name
        assert float(psi[live].std()) == pytest.approx(1.0, abs=1e-3), name


# MA-POCA


def attended(tokens, present, critic) -> float:
    """Residual self-attention, mean and head for one set, in NumPy loops."""
    weight, bias = (p.detach().numpy() for p in critic.attention.parameters())
    there = [token for token, is_there in zip(tokens, present, strict=True) if is_there]
    size = len(there[0])
    parts = [weight @ token + bias for token in there]
    out = []
    for token, part in zip(there, parts, strict=True):
        fits = [part[:size] @ other[size : 2 * size] / math.sqrt(size) for other in parts]
        shares = np.exp(fits) / np.exp(fits).sum()
        out.append(token + sum(s * other[2 * size :] for s, other in zip(shares, parts, strict=True)))
    with torch.no_grad():
        return float(critic.head(torch.tensor(np.mean(out, axis=0), dtype=torch.float32))[0])


def test_ma_poca_values_are_those_of_plain_loops() -> None:
    """V is of the living; baseline j is of o_j and the others' (o, a)."""
    trainer, inputs = played("hazard_nav-4", "ma_poca")
    critic, data = trainer.critic, inputs.data
    data.health[:, ::2, 2] = 0.0
    alive = data.health[3] > 0
    seen = critic.tokens(data.observation[3], data.elapsed[3])
    action = data.action[3]
    found = critic.predict(seen, action, alive).detach().numpy()
    own = torch.tanh(critic.embed(seen)).detach().numpy()
    acting = torch.tanh(critic.embed_acting(torch.cat([seen, action], -1))).detach().numpy()
    for b in range(6):
        assert found[b, 0] == pytest.approx(attended(own[b], alive[b], critic), abs=1e-4)
        for j in np.flatnonzero(alive[b]):
            tokens = [own[b, i] if i == j else acting[b, i] for i in range(4)]
            assert found[b, 1 + j] == pytest.approx(attended(tokens, alive[b], critic), abs=1e-4)


def test_a_ma_poca_baseline_does_not_depend_on_the_own_action_nor_on_the_dead() -> None:
    trainer, inputs = played("hazard_nav-4", "ma_poca")
    critic, data = trainer.critic, inputs.data
    data.health[:, :, 3] = 0.0
    target = inputs.target
    before = critic.predict(*critic.samples(data, target).inputs)
    data.action[..., 0, :] += 1.0
    moved = critic.predict(*critic.samples(data, target).inputs)
    torch.testing.assert_close(moved[:, :2], before[:, :2])  # V, and agent 0's own baseline
    assert (moved[:, 2] != before[:, 2]).any()
    data.action[..., 3, :] += 1.0
    data.observation[..., 3, :] += 1.0
    again = critic.predict(*critic.samples(data, target).inputs)
    torch.testing.assert_close(again[:, :4], moved[:, :4])


def test_ma_poca_of_a_team_that_is_dead() -> None:
    trainer, inputs = played("hazard_nav-4", "ma_poca")
    seen = trainer.critic.tokens(inputs.data.observation[0], inputs.data.elapsed[0])
    assert (trainer.critic.team_value(seen, torch.zeros(6, 4, dtype=torch.bool)) == 0).all()


# COMA


def test_coma_marginalises_the_own_action_only() -> None:
    """With Q = sum_i w_i . u_i, Psi_i = w_i . (u_i - mean of the drawn u'_i)."""
    trainer, inputs = played("hazard_nav-4", "coma", credit_samples=64)
    data = inputs.data
    weight = torch.arange(1.0, 5.0)[:, None] * torch.tensor([1.0, -2.0, 0.5])
    trainer.critic.q = lambda state, elapsed, action: (weight * action).sum((-2, -1))
    torch.manual_seed(7)
    with torch.no_grad():
        psi = credit.find("coma").psi(inputs)
    torch.manual_seed(7)
    with torch.no_grad():
        policy = trainer.actor(data.observation[:-1])
        drawn = torch.stack([policy.sample() for _ in range(64)]).mean(0)
    torch.testing.assert_close(psi, (weight * (data.action - drawn)).sum(-1), atol=1e-4, rtol=1e-4)


def test_coma_expects_zero_credit_over_the_own_actions() -> None:
    """E_u_i Psi_i = 0: the baseline is the mean over the policy (Foerster et al. 2018, lemma 1)."""
    trainer, inputs = played("hazard_nav-4", "coma", credit_samples=256)
    data = inputs.data
    torch.manual_seed(1)
    with torch.no_grad():
        policy, means = trainer.actor(data.observation[:-1]), []
        for _ in range(256):
            data.action[..., 0, :] = policy.sample()[..., 0, :]
            chosen = trainer.critic.q(data.state[:-1], data.elapsed[:-1], data.action)
            means.append(chosen)
        psi = credit.find("coma").psi(inputs)
        chosen = torch.stack(means)
        baseline = trainer.critic.q(data.state[:-1], data.elapsed[:-1], data.action) - psi[..., 0]
    error = chosen.std(0) / math.sqrt(256) * math.sqrt(2)
    assert ((chosen.mean(0) - baseline).abs() < 5 * error + 1e-5).all()


def test_comas_dead_have_no_say() -> None:
    trainer, inputs = played("hazard_nav-4", "coma")
    data, columns = inputs.data, torch.as_tensor(trainer.env.layout.health_columns)
    state = data.state[:-1].clone()
    state[..., columns[2]] = trainer.env.layout.dead_value
    before = trainer.critic.q(state, data.elapsed[:-1], data.action)
    data.action[..., 2, :] += 1.0
    torch.testing.assert_close(trainer.critic.q(state, data.elapsed[:-1], data.action), before)


# difference rewards


@pytest.mark.parametrize("task", ["hazard_nav-4", "multiwalker-3"])
def test_difference_rewards_are_those_of_forked_worlds(task: str) -> None:
    """One world and one agent at a time: reward with it less reward without it."""
    trainer, inputs = played(task, "difference_rewards", num_envs=3, rollout=4)
    data, env = inputs.data, trainer.env
    found = credit.find("difference_rewards").rewards(data, env)
    one = make(env.spec, 1, autoreset=False, threads=1)
    for t in range(4):
        for b in range(3):
            row, action = data.rows[t][b : b + 1], data.action[t, b : b + 1].numpy()
            one.load_rows(np.array([0]), row)
            whole = one.step(action).reward[0]
            assert whole == pytest.approx(float(data.reward[t, b]), abs=1e-5)
            for agent in range(env.num_agents):
                one.load_rows(np.array([0]), one.fork(row, {agent: 0.0}))
                without = one.step(action).reward[0]
                assert float(found[t, b, agent]) == pytest.approx(whole - without, abs=1e-4)
    assert found.abs().max() > 0.01


def test_an_agent_that_alone_covers_a_point_is_worth_what_it_covers() -> None:
    """With everybody else dead, D_i is the whole reward less that of a dead team."""
    trainer, inputs = played("hazard_nav-4", "difference_rewards", num_envs=2, rollout=2)
    env, data = trainer.env, inputs.data
    data.rows = [env.fork(rows, {1: 0.0, 2: 0.0, 3: 0.0}) for rows in data.rows]
    data.health[..., 1:] = 0.0
    lone = make(env.spec, 2, autoreset=False, threads=1)
    for t, rows in enumerate(data.rows):
        lone.load_rows(np.arange(2), rows)
        data.reward[t] = torch.from_numpy(lone.step(data.action[t].numpy()).reward)
    found = credit.find("difference_rewards").rewards(data, env)
    assert (found[..., 1:] == 0).all()
    for t, rows in enumerate(data.rows):
        lone.load_rows(np.arange(2), lone.fork(rows, {0: 0.0}))
        nobody = lone.step(data.action[t].numpy()).reward
        np.testing.assert_allclose(found[t, :, 0].numpy(), data.reward[t].numpy() - nobody, atol=1e-4)


# masks


def test_values_of_the_dead_are_trained_unless_they_are_masked() -> None:
    ends: dict[bool, list[torch.Tensor]] = {True: [], False: []}
    for masked, moved in ((masked, moved) for masked in ends for moved in (0.0, 5.0)):
        trainer = Trainer(recommended("hazard_nav-4", algorithm="local", mask_dead_values=masked, **SMALL))
        data = trainer.roll_out()
        data.health[:, :, 1] = 0.0
        target, psi = trainer.assign_credit(data)
        target[:, :, 1] += moved
        trainer.update(data, target, psi)
        ends[masked].append(torch.cat([p.detach().flatten() for p in trainer.critic.parameters()]))
    assert torch.equal(*ends[True])
    assert not torch.equal(*ends[False])


# the registry


def test_a_rule_from_outside_is_found_by_module_and_function(tmp_path: Path, monkeypatch) -> None:
    (tmp_path / "own_rule.py").write_text(
        "from hipg_bench.learning.credit import credit_rule\n"
        "def plain(inputs):\n    return inputs.target\n"
        "@credit_rule(always_masks=True)\ndef decorated(inputs):\n    return inputs.target - inputs.value\n"
        "number = 3\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    settings = recommended("coop_nav-3", algorithm="own_rule:plain", **{**SMALL, "steps": 60})
    train(settings, tmp_path / "run", command="test")
    assert (tmp_path / "run" / "policy.safetensors").exists()
    assert credit.find("own_rule:decorated").always_masks
    for wrong, why in (
        ("own_rule:number", "has no function 'number'"), ("own_rule:nothing", "has no function 'nothing'"),
        ("no_such_module:f", "no module 'no_such_module'"), ("min_helth", "did you mean 'min_health'"),
    ):  # fmt: skip
        with pytest.raises(SpecError, match=why):
            credit.find(wrong)


def test_the_documents_example_is_a_rule(tmp_path: Path, monkeypatch) -> None:
    (code,) = re.findall(
        r"```python\n(.*?)```", Path("docs/guides/own_credit_rule.md").read_text(), re.DOTALL
    )
    (tmp_path / "my_rules.py").write_text(code)
    monkeypatch.syspath_prepend(tmp_path)
    _, inputs = played("coop_nav-3", "central")
    psi = credit.find("my_rules:half_shared").psi(inputs)
    torch.testing.assert_close(psi, credit.find("central").psi(inputs) / 2)


@pytest.mark.parametrize("algorithm", [*CREDIT_RULES, "maddpg", "qmix"])
def test_settings_come_back_from_a_file(algorithm: str, tmp_path: Path) -> None:
    settings = recommended("multiwalker-3", algorithm=algorithm)
    (tmp_path / "own.toml").write_text(to_toml(settings))
    assert recommended("multiwalker-3", **read_settings(tmp_path / "own.toml")) == settings
