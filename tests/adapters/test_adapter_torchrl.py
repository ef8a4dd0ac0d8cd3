"""TorchRL: its own specification check, many worlds at once, partial resets, collectors."""

import itertools

import numpy as np
import pytest
import torch
from torchrl.collectors import Collector
from torchrl.envs import RewardSum, TransformedEnv, check_env_specs

from hipg_bench import make, task_spec
from hipg_bench.adapters.torchrl import HipgEnv
from hipg_bench.errors import ActionError, HipgError, SpecError, UnknownNameError

TASK = "hazard_nav-4"
DEADLY = {"hazard_peak": 0.3, "hazard_radius": 2.0, "horizon": 12}
WORLDS = 6


def actions(env, steps, seed=0):
    """(steps, B, N, A) random."""
    shape = (steps, *env.full_action_spec["agents", "action"].shape)
    return torch.from_numpy(np.random.default_rng(seed).uniform(-1, 1, shape).astype(np.float32))


def player(env, steps):
    """A policy that does the same each time."""
    told = iter(actions(env, steps))
    return lambda td: td.set(("agents", "action"), next(told))


def same(a, b):
    """All entries of two tensordicts, bit for bit."""
    assert set(a.keys(True, True)) == set(b.keys(True, True))
    return all(torch.equal(a[key], b[key]) for key in a.keys(True, True))


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    ("task", "overrides"),
    [(TASK, DEADLY | {"horizon": 2}), ("multiwalker-3", {}), ("hazard_comm-10", {}), ("paper_nav-4", {})],
)
@pytest.mark.parametrize("num_envs", [1, 5])
def test_the_specification_holds(task, overrides, num_envs):
    env = HipgEnv(task, num_envs, 0, **overrides)
    check_env_specs(env, seed=0)
    check_env_specs(env, break_when_any_done="both")
    check_env_specs(TransformedEnv(env, RewardSum(in_keys=[env.reward_key])))
    spec = task_spec(task)
    assert env.group_map == {"agents": [f"agent_{i}" for i in range(spec.num_agents)]}
    assert env.full_action_spec_unbatched["agents", "action"].shape[0] == spec.num_agents


def test_worlds_agree_with_the_batch_bit_for_bit_through_deaths_and_restarts():
    env, world = HipgEnv(TASK, WORLDS, 3, **DEADLY), make(TASK, WORLDS, 3, autoreset=False, **DEADLY)
    now, was = env.reset(), world.reset()
    deaths = restarts = 0
    for action in actions(env, 60):
        shown, now = env.step_and_maybe_reset(now.set(("agents", "action"), action))
        shown, step = shown["next"], world.step(action.numpy())
        alive, lived = step.info["final_alive"], was.info["alive"]
        lost = ~alive.any(axis=1)
        terminated, done = step.terminated | lost, step.terminated | step.truncated | lost
        expected = {
            ("agents", "observation"): step.observation,
            ("agents", "alive"): alive[..., None],
            ("agents", "reward"): np.where(lived, step.reward[:, None], 0.0)[..., None].astype(np.float32),
            "state": step.info["state"],
            "done": done[:, None],
            "terminated": terminated[:, None],
            "truncated": (step.truncated & ~lost)[:, None],
        }
        assert set(shown.keys(True, True)) == set(expected)
        for key, array in expected.items():
            np.testing.assert_array_equal(shown[key].numpy(), array, err_msg=str(key))
        was = world.reset(worlds=np.flatnonzero(done)) if done.any() else step
        np.testing.assert_array_equal(now["agents", "observation"].numpy(), was.observation)
        np.testing.assert_array_equal(now["state"].numpy(), was.info["state"])
        assert not now["done"].any()
        deaths += int((lived & ~alive).sum())
        restarts += int(done.sum())
    assert deaths > WORLDS
    assert restarts > WORLDS


def test_a_partial_reset_leaves_other_worlds_as_they_were():
    env = HipgEnv(TASK, WORLDS, 0, **DEADLY)
    now = env.reset()
    for action in actions(env, 4):
        now = env.step(now.set(("agents", "action"), action))["next"].exclude(("agents", "reward"))
    before, mask = now.clone(), torch.tensor([0, 1, 0, 0, 1, 0], dtype=torch.bool)[:, None]
    after = env.reset(now.set("_reset", mask))
    keep = ~mask[:, 0]
    assert same(after[keep], before[keep])
    begun = make(TASK, WORLDS, **DEADLY)
    begun.reset()
    fresh = begun.reset()
    np.testing.assert_array_equal(after["state"][~keep].numpy(), fresh.info["state"][:2])


def test_whole_episodes_of_all_worlds_in_which_those_that_are_over_stand_still():
    env, free = HipgEnv("multiwalker-3", WORLDS, 0), HipgEnv("multiwalker-3", WORLDS, 0)
    tape = env.rollout(400, player(env, 400), break_when_any_done=False, break_when_all_done=True)
    done = tape["next", "done"][..., 0]
    first = done.int().argmax(dim=1)
    assert done[:, -1].all()
    assert len(set(first.tolist())) > 1
    now = free.reset()
    for t, action in enumerate(actions(free, tape.shape[1])):
        shown, now = free.step_and_maybe_reset(now.set(("agents", "action"), action))
        running = t <= first
        assert same(shown["next"][running], tape["next"][running, t])
        if t:
            assert same(tape["next"][~running, t], tape["next"][~running, t - 1])
    assert env.reset()["done"].logical_not().all()


def test_a_world_that_is_left_out_of_a_step_is_where_it_was():
    env, other = (HipgEnv(TASK, 2, 0, **DEADLY | {"hazard_peak": 0.0}) for _ in range(2))
    first, second = actions(env, 2)
    now, same_now = env.reset(), other.reset()
    left_out = now.clone().set("_step", torch.tensor([True, False])).set(("agents", "action"), first)
    shown = env.step(left_out)["next"]
    assert torch.equal(shown["state"][1], now["state"][1])
    assert not torch.equal(shown["state"][0], now["state"][0])
    assert not shown["agents", "reward"][1].any()
    later = env.step(shown.set(("agents", "action"), second))["next"]
    straight = other.step(same_now.set(("agents", "action"), second))["next"]
    assert same(later[1], straight[1])


def test_a_seed_fixes_whole_episodes_whenever_it_is_set():
    env = HipgEnv(TASK, WORLDS, seed=0, **DEADLY)
    tapes = []
    for broken_off in (0, 5):
        env.rollout(broken_off + 1)
        env.set_seed(7)
        tapes.append(env.rollout(30, player(env, 30), break_when_any_done=False))
    assert same(*tapes)
    built = HipgEnv(TASK, WORLDS, seed=7, **DEADLY).reset()
    assert torch.equal(tapes[0]["state"][:, 0], built["state"])


def test_the_team_goes_on_being_paid_where_the_task_says_so():
    env = HipgEnv(TASK, WORLDS, 0, reward_dead="team", **DEADLY)
    tape = env.rollout(60, break_when_any_done=False)
    reward, alive = tape["next", "agents", "reward"], tape["agents", "alive"]
    assert not alive.all()
    assert (reward == reward[:, :, :1]).all()
    assert (reward < 0).all()
    assert not tape["next", "terminated"].any()


def test_the_arrays_are_the_worlds_own_and_later_steps_leave_them_alone():
    env = HipgEnv(TASK, WORLDS, 0, **DEADLY)
    now, kept = env.reset(), []
    for action in actions(env, 30):
        shown, now = env.step_and_maybe_reset(now.set(("agents", "action"), action))
        kept.append((shown, shown.clone()))
    assert all(same(shown, copy) for shown, copy in kept)


def test_a_collector_takes_whole_batches():
    env = HipgEnv(TASK, WORLDS, 0, **DEADLY)
    collector = Collector(env, None, frames_per_batch=WORLDS * 20, total_frames=WORLDS * 60)
    batches = list(collector)
    collector.shutdown()
    assert [batch.shape for batch in batches] == [(WORLDS, 20)] * 3
    for earlier, later in itertools.pairwise(batches):
        # an episode goes on from one batch to the next
        over = earlier["next", "done"][:, -1, 0]
        assert torch.equal(earlier["next", "state"][~over, -1], later["state"][~over, 0])
    assert all(batch["next", "done"].any() for batch in batches)


# bad input


def test_actions_that_are_refused():
    env = HipgEnv(TASK, WORLDS, 0)
    now = env.reset()
    bad = actions(env, 1)[0]
    bad[4, 2, 1] = float("nan")
    with pytest.raises(ActionError, match=rf"{TASK}: finite .* got nan for env 4, agent 2 \(thrust\[1\]"):
        env.step(now.clone().set(("agents", "action"), bad))
    with pytest.raises(ActionError, match=rf"{TASK}: .*shape \(6, 4, 3\) .* got \(6, 4, 2\)"):
        env.step(now.clone().set(("agents", "action"), bad[..., :2]))


def test_worlds_that_are_over_or_not_begun_or_closed_refuse_a_step():
    env = HipgEnv(TASK, WORLDS, 0, **DEADLY | {"hazard_peak": 0.9})
    action = env.rand_action()
    with pytest.raises(HipgError, match=f"{TASK}: env 0 .* waits for reset"):
        env.step(action)
    tape = env.rollout(100)
    over = int(tape["next", "done"][:, -1, 0].int().argmax())
    with pytest.raises(HipgError, match=f"{TASK}: env {over} .* waits for reset"):
        env.step(env.rand_action())
    env.reset()
    env.close()
    with pytest.raises(HipgError, match=f"{TASK}: this environment is closed"):
        env.step(env.rand_action())
    with pytest.raises(HipgError, match=f"{TASK}: this environment is closed"):
        env.reset()


def test_what_cannot_be_built():
    with pytest.raises(UnknownNameError, match="did you mean 'hazard_nav-4'"):
        HipgEnv("hazard_nv-4")
    with pytest.raises(SpecError, match="num_envs = 0 is refused"):
        HipgEnv(TASK, 0)
    with pytest.raises(SpecError, match="did you mean 'hazard_peak'"):
        HipgEnv(TASK, hazard_peek=0.1)
