"""Worlds in which an agent was killed: what they hold, what the critic is taught, that runs go on."""

import itertools
from pathlib import Path

import numpy as np
import pytest
import torch

from hipg_bench.learning import forks as module
from hipg_bench.learning.forks import Forks
from hipg_bench.learning.mappo import Trainer
from hipg_bench.learning.run import train
from hipg_bench.learning.settings import recommended

SMALL = {
    "num_envs": 8, "rollout": 10, "steps": 8 * 10 * 4, "actor_hidden": (16,), "critic_hidden": (16,),
    "eval_every": 0, "forks": 0.5,
}  # fmt: skip
TASK = "hazard_nav-4"


def small(task=TASK, **changes):
    return recommended(task, **{**SMALL, **changes})


def dead(env):
    return (env.recall(env.rows, "health") == 0).sum(axis=1)


def test_a_fork_is_a_world_of_the_rollout_without_one_of_the_living() -> None:
    trainer = Trainer(small())
    forks = trainer.forks
    assert forks is not None
    assert forks.env.num_envs == 4
    np.testing.assert_array_equal(dead(forks.env), 1)
    # where they are is where a world of the rollout is: all else but the dead one's health is the same
    rows, own = trainer.env.rows, forks.env.rows
    episodes = trainer.env.recall(rows, "episode_id")[:, 0].tolist()
    for row in own:
        origin = rows[episodes.index(forks.env.recall(row[None], "episode_id")[0, 0])]
        victim = int((forks.env.recall(row[None], "health")[0] == 0).argmax())
        np.testing.assert_array_equal(trainer.env.fork(origin[None], {victim: 0.0})[0], row)


def test_all_of_the_living_are_struck_alike() -> None:
    """Of 64 x 30 forks of worlds in which agent 2 is dead, each of the other three dies in about a third."""
    trainer = Trainer(small(num_envs=64, forks=1.0))
    rows = trainer.env.fork(trainer.env.rows, {2: 0.0})
    trainer.env.load_rows(np.arange(64), rows)
    forks = Forks(trainer.settings, trainer.env)
    struck = np.zeros(4)
    for _ in range(30):
        forks._renew(np.ones(64, bool), trainer.env)
        struck += (forks.env.recall(forks.env.rows, "health") == 0).sum(axis=0)
    assert struck[2] == 64 * 30
    # three binomial(1920, 1/3): deviation 21
    assert np.abs(struck[[0, 1, 3]] - 640).max() < 5 * 21


@pytest.mark.parametrize("bootstrap", [True, False])
def test_value_targets_are_those_of_a_plain_loop(bootstrap: bool, monkeypatch) -> None:
    """Discounted rewards while a fork lives, and the critic's value of where it was left."""
    monkeypatch.setattr(module, "_LIFE", 6)
    settings = small(
        gamma=0.9, gae_lambda=1.0, rollout=60, bootstrap_truncation=bootstrap
    )  # beyond the horizon of 50
    trainer = Trainer(settings)
    trainer.roll_out()
    forks, horizon = trainer.forks, trainer.env.spec.horizon
    seen = [dict(step) for step in forks._seen]
    state, elapsed, target = forks.harvest(trainer.critic)
    assert state.shape[:2] == elapsed.shape == target.shape == (60, 4)
    checked = cut = 0
    for f in range(4):
        for t in range(60):
            total, k = 0.0, t
            while True:
                step = seen[k]
                total += 0.9 ** (k - t) * float(step["reward"][f])
                if step["done"][f] or k == 59:
                    break
                k += 1
            at_horizon = bool(step["elapsed"][f] * horizon > horizon - 1.5)
            if bootstrap or not at_horizon:
                with torch.no_grad():
                    left = trainer.critic(step["next_state"][f], step["elapsed"][f] + 1 / horizon)
                total += 0.9 ** (k - t + 1) * float(left)
            cut += at_horizon
            checked += 1
            assert float(target[t, f]) == pytest.approx(total, abs=2e-3)
    assert checked == 240
    assert cut > 0, "some forks reached the horizon, which is at 50"


def test_forks_are_renewed_and_never_outlive_their_episode() -> None:
    trainer = Trainer(small(rollout=120))
    trainer.roll_out()
    seen = trainer.forks._seen
    done = torch.stack([step["done"] for step in seen]).float().mean()
    # one in 5, and at the horizon: 480 fork steps, so that the share's deviation is 0.02
    assert 0.12 < float(done) < 0.32
    elapsed = torch.stack([step["elapsed"] for step in seen])
    assert float(elapsed.max()) < 1.0
    for before, now in itertools.pairwise(seen):
        going = ~before["done"]
        torch.testing.assert_close(now["elapsed"][going], before["elapsed"][going] + 1 / 50)


def test_only_the_critic_learns_from_forks() -> None:
    """With the actor's data the same, forks change the critic's step and not the actor's."""
    trainers, rollouts = [], []
    for _ in range(2):  # one after the other: chance is torch's, set when a trainer is made
        trainers.append(Trainer(small()))
        rollouts.append(trainers[-1].roll_out())
    torch.testing.assert_close(rollouts[0].action, rollouts[1].action)
    for step in trainers[1].forks._seen:
        step["reward"] = step["reward"] - 100
    for trainer, data in zip(trainers, rollouts, strict=True):
        torch.manual_seed(0)
        trainer.update(data, *trainer.assign_credit(data))
    actors, critics = ([getattr(one, name).state_dict() for one in trainers] for name in ("actor", "critic"))
    for name, tensor in actors[0].items():
        torch.testing.assert_close(tensor, actors[1][name], rtol=0, atol=0)
    weights = [name for name in critics[0] if name.startswith("body")]
    assert any(not torch.equal(critics[0][name], critics[1][name]) for name in weights)


def test_a_resumed_run_with_forks_is_the_same_run(tmp_path: Path) -> None:
    settings = small()
    train(settings, tmp_path / "whole", command="test")
    train(settings.model_copy(update={"steps": 8 * 10 * 2}), tmp_path / "cut", command="test")
    train(settings, tmp_path / "cut", command="test")
    whole, cut = ((tmp_path / name / "learner.safetensors") for name in ("whole", "cut"))
    assert whole.read_bytes() == cut.read_bytes()


def test_a_local_critic_has_no_use_for_forks() -> None:
    assert Trainer(small(algorithm="local")).forks is None
