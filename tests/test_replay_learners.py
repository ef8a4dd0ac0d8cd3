"""MADDPG and QMIX: losses against plain loops, a replay of the latest steps, runs that go on after a kill."""

import csv
import subprocess
import sys
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
import torch

from hipg_bench.claims import CLAIM
from hipg_bench.errors import HipgError, ResumeError, SpecError
from hipg_bench.learning import maddpg, qmix
from hipg_bench.learning.replay import Replay
from hipg_bench.learning.run import Learner, new_learner, train
from hipg_bench.learning.settings import ALGORITHMS, paper, recommended
from hipg_bench.policies.network import load_network

SMALL = {
    "num_envs": 8, "rollout": 10, "steps": 8 * 10 * 8, "hidden": (16,), "batch": 32, "buffer": 8 * 25,
    "learning_starts": 100, "update_every": 40,
}  # fmt: skip
DEADLY = "hazard_nav-4"
ALGORITHM = {"maddpg": maddpg.Trainer, "qmix": qmix.Trainer}


@pytest.fixture(params=ALGORITHM)
def algorithm(request):
    return request.param


def small(algorithm, task=DEADLY, **changes):
    return recommended(task, algorithm=algorithm, **{**SMALL, **changes})


def trained(algorithm, folder, **changes):
    """A learner whose targets have parted from its networks, and a sample with every kind of ending."""
    trainer = ALGORITHM[algorithm](small(algorithm, tau=0.3, **changes), folder)
    trainer.iterate()
    trainer.iterate()
    assert trainer.updates > 0
    batch = trainer._sample()
    batch["next", "terminated"][:7] = True
    batch["next", "done"] = batch["next", "terminated"]
    batch["acting"][:5, 1] = 0.0
    batch["next", "acting"][3:9, 1] = 0.0
    return trainer, batch


class Diary:
    """What a replay of the latest steps should hold: a list for every world."""

    def __init__(self, worlds):
        self.steps = [[] for _ in range(worlds)]
        self.shown = np.arange(worlds) * 1000.0
        self.rng = np.random.default_rng(0)

    def views(self):
        return {"seen": self.shown.astype(np.float32)}

    def step(self, replay):
        """All worlds go on by one; some episodes end."""
        worlds = len(self.shown)
        played = self.rng.normal(size=worlds).astype(np.float32)
        led_to = self.shown + 1
        done = self.rng.random(worlds) < [0.0, 0.3, 1.0][:worlds]
        after = np.where(done, led_to + 1, led_to)
        for world in range(worlds):
            self.steps[world].append((self.shown[world], played[world], led_to[world]))
        self.shown = after
        replay.add({"played": played}, self.views(), done, {"seen": led_to[done].astype(np.float32)})


def replay(folder, window=12, spare=8):
    return Replay(
        folder, 3, window, spare, {"seen": np.zeros((), np.float32)}, {"played": np.zeros((), np.float32)}
    )


def drawn(buffer, n=20_000):
    now, led_to = buffer.sample(n)
    return Counter(zip(now["seen"].tolist(), now["played"].tolist(), led_to["seen"].tolist(), strict=True))


def test_a_replay_draws_the_latest_steps_evenly(tmp_path: Path) -> None:
    torch.manual_seed(0)
    diary, buffer = Diary(3), replay(tmp_path)
    buffer.begin(diary.views())
    for k in range(40):
        diary.step(buffer)
        if k in (0, 5, 39):
            counts = drawn(buffer)
            # world 0 never ends, world 2 always: of its 12 rows every second closes an episode
            latest = [diary.steps[0][-12:], [s for s in diary.steps[1] if s in counts], diary.steps[2][-6:]]
            assert set(counts) == {step for steps in latest for step in steps}
            assert latest[1] == diary.steps[1][-len(latest[1]) :], "the latest of world 1, without a gap"
            assert min(12, k + 1) >= len(latest[1]) >= min(6, k + 1)
    for steps in latest:
        of_world = np.array([counts[step] for step in steps])
        expected = of_world.sum() / len(steps)
        assert (abs(of_world - expected) < 5 * expected**0.5).all()


def test_a_replay_goes_on_as_it_was_at_the_checkpoint(tmp_path: Path) -> None:
    diary, buffer = Diary(3), replay(tmp_path)
    buffer.begin(diary.views())
    for _ in range(30):
        diary.step(buffer)
    torch.manual_seed(1)
    expected = drawn(buffer, 500)
    saved = {name: tensor.clone() for name, tensor in buffer.state_dict().items()}
    for _ in range(4):  # 8 rows in the world that always ends: what the ring can spare
        diary.step(buffer)
    again = replay(tmp_path)
    assert not again.lost
    again.load_state_dict(saved)
    torch.manual_seed(1)
    assert drawn(again, 500) == expected


def test_what_truncation_led_to_is_the_episodes_own_end(tmp_path: Path) -> None:
    """hazard_nav ends after 50 steps by truncation: targets must see the last view, not the next start."""
    trainer = maddpg.Trainer(small("maddpg", rollout=60, learning_starts=10_000, buffer=10_000), tmp_path)
    last = {}
    step = trainer.env.step

    def watched(action):
        now = step(action)
        for k, world in enumerate(np.flatnonzero(now.truncated)):
            last[world] = now, now.info["final_observation"][k]
        return now

    trainer.env.step = watched
    trainer.iterate()
    assert len(last) == 8
    arrays, rows = trainer.replay._arrays, trainer.replay._rows
    for world, (now, seen) in last.items():
        closing = np.flatnonzero(~arrays["starts"][:60, world]).tolist()
        assert len(closing) == 1
        row = closing[0]
        assert (arrays["observation"][row, world] == seen).all()
        assert (arrays["observation"][(row + 1) % rows, world] == now.observation[world]).all()
        assert not arrays["terminated"][row - 1, world]
        assert arrays["reward"][row - 1, world] == np.float32(now.reward[world])


def critic_by_hand(params, agent, num_agents, state, actions):
    """One agent's Q of (X, S) states and a list of N actions (X, A), layer by layer."""
    width = len(params["seen", "weight"]) // num_agents
    seen = params["seen", "weight"][agent * width : (agent + 1) * width]
    joint = torch.cat(actions, -1)
    hidden = state @ seen.T + joint @ params["played", "params", "0", "weight"][agent].T
    hidden = torch.relu(hidden + params["played", "params", "0", "bias"][agent])
    last = params["rest", "params", "0", "weight"][agent], params["rest", "params", "0", "bias"][agent]
    return (hidden @ last[0].T + last[1])[:, 0]


def actor_by_hand(params, agent, observation):
    """One agent's action."""
    layers = params["body", "params"]
    hidden = torch.relu(observation[:, agent] @ layers["0", "weight"][agent].T + layers["0", "bias"][agent])
    return torch.tanh(hidden @ layers["2", "weight"][agent].T + layers["2", "bias"][agent])


def maddpg_by_hand(trainer, batch):
    """Both losses of Lowe et al. (2017), one agent and one network at a time."""
    loss, num_agents, after = trainer.loss, trainer.env.num_agents, batch["next"]
    critic, actor = loss.value_network_params["module"], loss.actor_network_params["module"]
    later_critic = loss.target_value_network_params["module"]
    later_actor = loss.target_actor_network_params["module"]
    played = [batch["action"][:, j] for j in range(num_agents)]
    then = [actor_by_hand(later_actor, j, after["observation"]) for j in range(num_agents)]
    then = [then[j] * after["acting"][:, j, None] for j in range(num_agents)]
    value_loss = actor_loss = 0.0
    for i in range(num_agents):
        future = critic_by_hand(later_critic, i, num_agents, after["state"], then)
        future = torch.where(after["terminated"][:, 0], 0.0, future)
        target = (after["reward"][:, 0] + trainer.settings.gamma * future).detach()
        value = critic_by_hand(critic, i, num_agents, batch["state"], played)
        value_loss += (value - target).square().mean() / num_agents
        own = actor_by_hand(actor, i, batch["observation"]) * batch["acting"][:, i, None]
        chosen = [own if j == i else played[j] for j in range(num_agents)]
        actor_loss -= critic_by_hand(critic, i, num_agents, batch["state"], chosen).mean() / num_agents
    return value_loss, actor_loss


def test_maddpg_losses_against_a_loop_over_agents(tmp_path: Path) -> None:
    trainer, batch = trained("maddpg", tmp_path, critic_hidden=(16,), pretanh_l2=0.0, max_grad_norm=1e9)
    value_loss, actor_loss = maddpg_by_hand(trainer, batch)
    actor = list(trainer.loss.actor_network_params.parameters())
    expected = torch.autograd.grad(actor_loss, actor)
    log = trainer.improve(batch)
    assert log["value_loss"] == pytest.approx(float(value_loss.detach()), rel=1e-4)
    assert log["value"] == pytest.approx(-float(actor_loss.detach()), rel=1e-4)
    for parameter, gradient in zip(actor, expected, strict=True):
        torch.testing.assert_close(parameter.grad / trainer.env.num_agents, gradient, rtol=1e-3, atol=1e-7)


def test_maddpg_can_show_critics_all_observations(tmp_path: Path) -> None:
    trainer = maddpg.Trainer(small("maddpg", critic_sees="observations", critic_hidden=(16,)), tmp_path)
    env = trainer.env
    assert trainer.loss.value_network_params["module", "seen", "weight"].shape == (
        env.num_agents * 16, env.num_agents * env.observation_size
    )  # fmt: skip
    for _ in range(2):
        log = trainer.iterate()
    assert np.isfinite(log["value_loss"])


def test_gradients_are_cut_for_every_agent_and_tensor_apart() -> None:
    # two agents: norms 5 and 0.5, cut to 1; a weight whose first axis begins with agents: norms 2 and 1
    own = torch.nn.Parameter(torch.zeros(2, 1, 2))
    flat = torch.nn.Parameter(torch.zeros(4, 1))
    own.grad = torch.tensor([[[3.0, 4.0]], [[0.3, 0.4]]])
    flat.grad = torch.tensor([[2.0], [0.0], [0.6], [0.8]])
    maddpg.clip_gradients([own, flat], 2, 1.0)
    torch.testing.assert_close(own.grad, torch.tensor([[[0.6, 0.8]], [[0.3, 0.4]]]))
    torch.testing.assert_close(flat.grad, torch.tensor([[1.0], [0.0], [0.6], [0.8]]))


def mixed_by_hand(params, values, state):
    """Q_tot of Rashid et al. (2018): two layers with weights >= 0 that the state sets, for one sample."""
    affine = lambda name: params[name, "weight"] @ state + params[name, "bias"]  # noqa: E731
    width = len(affine("hyper_b_1"))
    first = affine("hyper_w_1").abs().view(len(values), width)
    hidden = torch.nn.functional.elu(values @ first + affine("hyper_b_1"))
    level = torch.relu(params["V", "0", "weight"] @ state + params["V", "0", "bias"])
    return (
        hidden @ affine("hyper_w_final").abs() + params["V", "2", "weight"] @ level + params["V", "2", "bias"]
    )


def pairs_by_hand(params, observation, acting, bins):
    """(N * A, bins) values of one sample, agent by agent."""
    rows = []
    for own, counts in zip(observation, acting, strict=True):
        hidden = torch.relu(params["0", "weight"] @ own + params["0", "bias"])
        out = (params["2", "weight"] @ hidden + params["2", "bias"]) * counts
        rows += [out[start : start + bins] for start in range(0, len(out), bins)]
    return torch.stack(rows)


def test_qmix_loss_against_a_loop_over_samples(tmp_path: Path) -> None:
    trainer, batch = trained("qmix", tmp_path)
    loss, after, bins = trainer.loss, batch["next"], trainer.settings.bins
    values, mixer = (
        loss.local_value_network_params["module", "0", "module", "body", "params"],
        loss.mixer_network_params["module"],
    )
    later = loss.target_local_value_network_params["module", "0", "module", "body", "params"]
    later_mixer = loss.target_mixer_network_params["module"]
    errors = []
    for x in range(len(batch)):
        now = pairs_by_hand(values, batch["observation"][x], batch["acting"][x], bins)
        chosen = now[torch.arange(len(now)), batch["action"][x].flatten().long()]
        total = mixed_by_hand(mixer, chosen, batch["state"][x])
        best = pairs_by_hand(later, after["observation"][x], after["acting"][x], bins).max(-1).values
        future = 0.0 if after["terminated"][x] else mixed_by_hand(later_mixer, best, after["state"][x])
        errors.append((total - after["reward"][x] - trainer.settings.gamma * future).item())
    assert trainer.improve(batch)["value_loss"] == pytest.approx(np.mean(np.square(errors)), rel=1e-3)


def test_the_policy_file_is_what_acts(algorithm, tmp_path: Path) -> None:
    trainer = ALGORITHM[algorithm](
        small(algorithm, **({"action_scale": 3.0} if algorithm == "maddpg" else {})), tmp_path
    )
    for _ in range(3):
        trainer.iterate()
    trainer.save_policy(tmp_path / "policy.safetensors")
    policy = load_network(tmp_path / "policy.safetensors")
    assert policy.num_agents == (4 if algorithm == "maddpg" else None)
    observation, alive = trainer.step.observation, trainer.step.info["alive"]
    action, _ = policy.act(observation, None, alive)
    trainer.exploration.sigma = trainer.exploration.eps = torch.tensor(0.0)  # one of them is its own
    with torch.no_grad():
        choice = trainer.choose(trainer.norm(torch.from_numpy(observation)), torch.ones(alive.shape))
    np.testing.assert_allclose(action, trainer.pushes(choice), atol=3e-5)
    assert np.abs(action).max() <= trainer.spec.reach


def test_what_the_dead_are_told_counts_only_where_they_are_not_masked(algorithm, tmp_path: Path) -> None:
    ends = {True: [], False: []}
    for masked in ends:
        for moved in (0, 1):
            folder = tmp_path / f"{masked}{moved}"
            trainer = ALGORITHM[algorithm](small(algorithm, mask_dead=masked), folder)
            for _ in range(2):
                trainer.iterate()
            alive = torch.ones(32, 4, dtype=torch.bool)
            alive[:, 1] = False
            batch = trainer._sample()
            batch["acting"] = trainer._acting(alive)
            if algorithm == "qmix":
                batch["action"][:, 1] = moved
            else:
                batch["action"][:, 1] = (
                    0.0  # as it is stored; what its actor would say depends on what it sees
                )
                batch["observation"][:, 1] = float(moved)
            before = [p.detach().clone() for p in trainer.body.parameters()]
            trainer.improve(batch)
            after = [p.detach().clone() for p in trainer.body.parameters()]
            assert any((a != b).any() for a, b in zip(before, after, strict=True))
            if algorithm == "maddpg" and masked:
                # earlier gradients go on in Adam, so that only the new one is looked at
                assert all((p.grad[1] == 0).all() for p in trainer.body.parameters())
            ends[masked].append(torch.cat([p.flatten() for p in after]))
    assert torch.equal(*ends[True])
    assert not torch.equal(*ends[False])


def test_dead_agents_steps_stay_with_zeros_for_actions(algorithm, tmp_path: Path) -> None:
    from hipg_bench.registry import make

    trainer = ALGORITHM[algorithm](
        small(algorithm, learning_starts=10_000, buffer=10_000, mask_dead=False), tmp_path
    )
    trainer.env = make(DEADLY, 8, 0, hazard_peak=0.9, hazard_radius=2.0, threads=1)
    trainer.step = trainer.env.reset()
    trainer.iterate()
    now, led_to = trainer.replay.sample(2000)
    dead = ~now["alive"]
    assert dead.float().mean() > 0.3
    assert (now["action"][dead] == 0).all()
    assert (now["action"][~dead] != 0).any()
    columns = trainer.env.layout.observation.slices[trainer.env.layout.health_block]
    assert (now["observation"][dead][:, columns] == 0).all()
    assert (now["observation"][~dead][:, columns] == 1).all()
    assert not (led_to["alive"] & dead).any(), "nobody rises within an episode"


class KilledError(Exception):
    pass


def test_a_killed_run_is_the_same_run(algorithm, tmp_path: Path) -> None:
    settings = small(algorithm)
    train(settings, tmp_path / "whole", command="test")

    def kill(iteration, log):
        if iteration == 6:
            raise KilledError

    with pytest.raises(KilledError):  # within iteration 6: five are saved, the ring has been round once
        train(settings, tmp_path / "cut", command="test", report=kill)
    train(settings, tmp_path / "cut", command="test")
    whole, cut = ((tmp_path / name / "policy.safetensors").read_bytes() for name in ("whole", "cut"))
    assert whole == cut
    rows = [list(csv.DictReader((tmp_path / name / "curve.csv").open())) for name in ("whole", "cut")]
    assert [row["steps"] for row in rows[0]] == [str(80 * k) for k in range(1, 9)]
    for a, b in zip(*rows, strict=True):
        assert {**a, "seconds": ""} == {**b, "seconds": ""}


def test_a_finished_run_is_left_alone_and_gives_its_disk_back(algorithm, tmp_path: Path) -> None:
    settings = small(algorithm, steps=240)
    train(settings, tmp_path, command="test")
    before = (tmp_path / "policy.safetensors").read_bytes()
    train(settings, tmp_path, command="test")
    assert (tmp_path / "policy.safetensors").read_bytes() == before
    assert {path.name for path in tmp_path.iterdir() if not path.name.startswith(CLAIM)} == {
        "checkpoint.pt", "policy.safetensors", "curve.csv", "train.json", "tensorboard",
        ".checkpoint.pt.sha256", ".curve.csv.sha256",
    }  # fmt: skip
    with pytest.raises(ResumeError, match="replay"):
        train(small(algorithm, steps=480), tmp_path, command="test")
    with pytest.raises(ResumeError, match="gamma"):
        train(small(algorithm, steps=240, gamma=0.5), tmp_path, command="test")
    with pytest.raises(ResumeError, match="algorithm"):
        train(small({"maddpg": "qmix", "qmix": "maddpg"}[algorithm], steps=240), tmp_path, command="test")


def test_every_algorithm_is_a_learner(tmp_path: Path) -> None:
    for name in ALGORITHMS:
        changes = {} if name not in ALGORITHM else SMALL
        assert isinstance(
            new_learner(recommended(DEADLY, algorithm=name, **changes), tmp_path / name), Learner
        )


def test_a_buffer_beyond_the_disk_is_refused(tmp_path: Path) -> None:
    with pytest.raises(HipgError, match=r"GB.*--set buffer"):
        maddpg.Trainer(recommended("hazard_comm-16", algorithm="maddpg", buffer=100_000_000), tmp_path)


def test_the_authors_maddpg_is_the_papers_preset() -> None:
    settings = paper("paper_nav-8", algorithm="maddpg")
    # facts sheet, section 5
    assert (settings.batch, settings.buffer, settings.learning_starts) == (1024, 1_000_000, 51_200)
    assert (settings.update_every, settings.tau, settings.max_grad_norm) == (100, 0.01, 0.5)
    assert (settings.gamma, settings.hidden, settings.critic_hidden) == (0.95, (64, 64), (64, 64))
    assert (settings.action_scale, settings.critic_sees, settings.mask_dead) == (5.0, "observations", False)
    assert paper("multiwalker_planar-3", algorithm="maddpg").action_scale == 1.0, (
        "a task that clips has no use for more"
    )
    assert paper("multiwalker_planar-3", algorithm="qmix").bins == 8


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"algorithm": "maddpg", "epochs": 3}, "no field 'epochs'"),
        ({"algorithm": "qmix", "bins": 1}, "bins = 1"),
        ({"algorithm": "maddpg", "final_noise": 1.5}, "final_noise = 1.5"),
        ({"algorithm": "maddpg", "hidden": ()}, "hidden"),
        ({"algorithm": "qmixx"}, "no algorithm 'qmixx'; did you mean 'qmix'?"),
    ],
)
def test_wrong_settings_are_refused(changes, message) -> None:
    with pytest.raises(SpecError) as caught:
        recommended(DEADLY, **changes)
    assert message in str(caught.value)


def test_without_torchrl_the_error_says_what_to_install(tmp_path: Path) -> None:
    program = f"""
import sys
from hipg_bench.learning.run import new_learner
from hipg_bench.learning.settings import recommended
assert "torchrl" not in sys.modules and "tensordict" not in sys.modules
sys.modules["torchrl"] = sys.modules["tensordict"] = None
from pathlib import Path
new_learner(recommended({DEADLY!r}, num_envs=2), Path({str(tmp_path)!r}))
new_learner(recommended({DEADLY!r}, algorithm="qmix"), Path({str(tmp_path)!r}))
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=120)
    assert "HipgError: algorithm 'qmix' needs TorchRL: pip install 'hipg-bench[torchrl]'" in done.stderr
