"""Laws of the worlds behind every task: rows, forks, forces, looks, and what divergence may touch."""

from __future__ import annotations

import os
from collections.abc import Callable

import mujoco
import numpy as np
import pytest
from play import action, actions, flat, outcomes, play, same

import hipg_bench
from hipg_bench import BatchEnv, TaskSpec, make
from hipg_bench.env import world_model

TASKS = sorted(hipg_bench.tasks())
KIND = mujoco.mjtObj
NAMED = {
    "nbody": KIND.mjOBJ_BODY, "njnt": KIND.mjOBJ_JOINT, "ngeom": KIND.mjOBJ_GEOM, "nsite": KIND.mjOBJ_SITE,
    "ncam": KIND.mjOBJ_CAMERA, "nlight": KIND.mjOBJ_LIGHT, "nu": KIND.mjOBJ_ACTUATOR,
    "nsensor": KIND.mjOBJ_SENSOR, "nmat": KIND.mjOBJ_MATERIAL, "ntex": KIND.mjOBJ_TEXTURE,
    "nmesh": KIND.mjOBJ_MESH, "ntendon": KIND.mjOBJ_TENDON, "neq": KIND.mjOBJ_EQUALITY,
}  # fmt: skip
"""Model sizes and the kind of element they count."""


@pytest.fixture(scope="module", params=TASKS)
def env(request: pytest.FixtureRequest) -> BatchEnv:
    return make(request.param, 4, threads=1, horizon=30)


@pytest.fixture(scope="module")
def visual(env: BatchEnv) -> mujoco.MjModel:
    return world_model(env.definition, visual=True)


def own_actuators(env: BatchEnv, agent: int) -> np.ndarray:
    """(nu,) the actuators that move an agent, by the name of its bodies and not by their group.

    An actuator acts on a joint of one tree of bodies, and no two agents share a tree.
    """
    model = env.model
    tree = model.dof_treeid[model.jnt_dofadr[model.actuator_trnid[:, 0]]]
    first = tree[agent * model.nu // env.num_agents]
    return tree == first


def actuator_forces(env: BatchEnv, world: int, control: float | None = None) -> np.ndarray:
    """(nu,) forces on a plain MjData loaded with the world, its disable mask included."""
    model, data = env._stepper.sim.batch.get_model(world), env._stepper.sim.batch.get_data(world)
    if control is not None:
        data.ctrl[:] = control
    mujoco.mj_forward(model, data)
    return data.actuator_force.copy()


def everything_but_control(env: BatchEnv) -> np.ndarray:
    """(B, R') all that evolves, without the actuators' inputs of the last step."""
    rows, kind = env.rows, mujoco.mjtState
    start = mujoco.mj_stateSize(env.model, int(kind.mjSTATE_INTEGRATION) & (int(kind.mjSTATE_CTRL) - 1))
    return np.delete(rows, np.s_[start : start + env.model.nu], axis=1)


def test_the_dead_exert_no_force_whatever_they_are_told(env: BatchEnv):
    for agent in (0, env.num_agents - 1):
        play(env, env.reset(), 3)
        step = env.load_rows(np.arange(4), env.fork(env.rows, {agent: 0.0}))
        env.step(actions(env, step))
        mine = own_actuators(env, agent)
        assert mine.sum() == env.model.nu / env.num_agents
        for told in (None, 1.0, -1.0):
            force = actuator_forces(env, 0, told)
            assert (force[mine] == 0).all()
            assert told is None or (force[~mine] != 0).any(), "the living must be able to act"


def test_what_the_dead_are_told_changes_nothing(env: BatchEnv):
    after: list[np.ndarray] = []
    for told in (0.0, 1.0, -1.0, 1e9, np.nan):
        step = env.reset(np.array([3, 1, 5, 9]))
        step = env.load_rows(np.arange(4), env.fork(env.rows, {1: 0.0}))
        for _ in range(5):
            command = actions(env, step)
            command[:, 1] = told
            step = env.step(command)
        after.append(everything_but_control(env))
    for rows in after[1:]:
        assert same(rows, after[0])


def test_a_fork_kills_exactly_whom_it_names(env: BatchEnv):
    play(env, env.reset(), 4)
    rows, victim = env.rows, env.num_agents // 2
    alive = env.load_rows(np.arange(4), rows).info["health"]
    forked = env.fork(rows, {victim: 0.0})
    assert same(rows, env.rows), "the fork must not touch the rows it came from"
    step = env.load_rows(np.arange(4), forked)
    others = np.arange(env.num_agents) != victim
    assert (step.info["health"][:, victim] == 0).all()
    assert same(step.info["health"][:, others], alive[:, others])
    # nothing but the victim's health and its time of death differs
    differing = (forked != rows).any(axis=0).sum()
    assert differing == 2
    assert not env.step(actions(env, step)).info["final_alive"][:, victim].any()


def test_saved_rows_go_on_bit_for_bit(env: BatchEnv):
    first = env.reset(np.array([0, 1, 2, 3]))
    middle = play(env, first, 12)[-1]
    rows = env.rows
    ahead = outcomes(env, middle, play(env, middle, 25))
    other = make(env.spec, 6, threads=2)
    play(other, other.reset(), 7)
    places = np.array([5, 0, 3, 2])
    step = other.load_rows(places, rows)
    assert same(step.observation[places], middle.observation)
    assert same(step.info["state"][places], middle.info["state"])
    again = outcomes(other, step, play(other, step, 25))
    shared = [key for key in ahead if key in again]
    assert len(shared) >= 4 * 10
    for key in shared:
        for name, value in ahead[key].items():
            assert same(value, again[key][name]), (key, name)


def test_a_reset_leaves_what_the_engines_own_reset_leaves(env: BatchEnv):
    stepper, ids = env._stepper, np.array([2, 0])
    sim, clean = stepper.sim, make(env.spec, 4, threads=1)
    play(env, env.reset(), 2)
    place = clean.definition.family.PHYSICS["QPOS"][0]
    stepper.worlds[place][0] = np.nan
    sim.advance()
    others = sim.rows[[1, 3]].copy()
    env.reset(np.array([7, 8]), worlds=ids)
    ours = sim.rows[ids].copy()
    # counts begin at 1, so that MuJoCo prints nothing and writes no file
    assert (sim.batch.warning[ids, :, 1] == 1).all()
    assert same(sim.rows[[1, 3]], others)
    # where an episode begins afresh, and where MuJoCo itself put the world before
    assert same(clean.reset(np.array([7, 8, 9, 10])).observation[:2], env.arrange().observation[ids])
    assert same(clean.rows[:2], ours)


def spoil(env: BatchEnv, world: int, value: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the next step's physics of a world begin with a velocity that no physics can go on from."""
    stepper = env._stepper
    advance, name = stepper.sim.advance, env.definition.family.PHYSICS["QVEL"][0]

    def once() -> None:
        stepper.worlds[name][world] = value
        monkeypatch.setattr(stepper.sim, "advance", advance)
        advance()

    monkeypatch.setattr(stepper.sim, "advance", once)


@pytest.mark.parametrize("value", [np.nan, 1e30], ids=["nan", "huge"])
def test_divergence_ends_only_its_own_episode(
    env: BatchEnv, value: float, tmp_path: object, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.chdir(str(tmp_path))
    calm, broken = env.reset(np.arange(4)), make(env.spec, 4, threads=2)
    disturbed = broken.reset(np.arange(4))
    for t in range(34):
        was, was_calm = disturbed, calm
        command = np.stack([action(env, b, t) for b in range(4)])
        if t == 6:
            spoil(broken, 2, value, monkeypatch)
        calm, disturbed = env.step(command), broken.step(command)
        for name, array in flat(disturbed).items():
            if array.dtype.kind == "f" and "metrics" not in name:
                assert np.isfinite(array).all(), name
        if t == 6:
            assert disturbed.info["end_reason"].tolist()[2] == "physics"
            assert disturbed.terminated[2]
            assert not disturbed.truncated[2]
            assert disturbed.info["metrics"]["return"][2] == pytest.approx(env.spec.floor, abs=1e-9)
            assert disturbed.info["terms"]["physics"][2] == disturbed.reward[2]
            assert disturbed.info["elapsed"][2] == 0
            fresh = make(env.spec, 1, threads=1).reset(disturbed.info["episode_id"][[2]])
            assert same(fresh.observation[0], disturbed.observation[2])
        for b in (0, 1, 3):
            # what is observed at an episode's end is the next one's start, and they are not the same
            if any(step.info["episode_id"][b] != b for step in (was, was_calm, calm, disturbed)):
                continue
            for name in (
                "reward",
                "terminated",
                "observation",
                "info.state",
                "info.end_reason",
            ):
                assert same(flat(calm)[name][b], flat(disturbed)[name][b]), (t, name)
    assert (disturbed.info["end_reason"] != "physics").all()
    assert not os.listdir(), "MuJoCo would write its warnings to a file in the working folder"


def test_every_element_has_a_name(visual: mujoco.MjModel):
    for size, kind in NAMED.items():
        nameless = [i for i in range(getattr(visual, size)) if not mujoco.mj_id2name(visual, int(kind), i)]
        assert not nameless, (size, nameless)
    assert visual.ncam >= 2


def test_looks_do_not_change_the_world(env: BatchEnv, visual: mujoco.MjModel):
    """Rows fit both models, and a plain MjData moves bit for bit alike in both."""
    play(env, env.reset(), 5)
    spec = int(mujoco.mjtState.mjSTATE_INTEGRATION)
    size = mujoco.mj_stateSize(env.model, spec)
    assert size == mujoco.mj_stateSize(visual, spec) == env.rows.shape[1]
    assert visual.ngeom > env.model.ngeom, "there must be something to see"
    assert same(visual.body_mass, env.model.body_mass)
    assert same(visual.body_inertia, env.model.body_inertia)
    ends: list[np.ndarray] = []
    for model in (env.model, visual):
        data, row = mujoco.MjData(model), np.empty(size)
        mujoco.mj_setState(model, data, env.rows[0], spec)
        mujoco.mj_step(model, data, 20 * env.decimation)
        mujoco.mj_getState(model, data, row, spec)
        ends.append(row)
    assert same(*ends)


def refuse(env: BatchEnv) -> list[tuple[Callable[[], object], str]]:
    """Wrong uses and what their error must name."""
    rows, n = env.rows, env.num_agents
    bad = np.zeros((4, n, env.action_size))
    bad[2, 1, 0] = np.nan
    return [
        (lambda: env.step(np.zeros((4, n + 1, env.action_size))), str((4, n, env.action_size))),
        (lambda: env.step(bad), "env 2, agent 1"),
        (lambda: env.reset(np.array([0, 1, 2, -1])), "0..2^53 - 1"),
        (lambda: env.reset(worlds=np.array([4])), "0..3"),
        (lambda: env.reset(worlds=np.array([1, 1])), "distinct"),
        (lambda: env.reset(seed=-1), "seed = -1 is refused: a whole number in 0.."),
        (lambda: env.load_rows(np.array([4]), rows[:1]), "0..3"),
        (lambda: env.load_rows(np.array([1, 1]), rows[:2]), "distinct"),
        (lambda: env.load_rows(np.array([0]), rows[:1, :-1]), str(rows.shape[1])),
        (lambda: env.fork(rows, {n: 0.0}), f"0..{n - 1}"),
        (lambda: env.fork(rows, {0: 1.5}), "1.5"),
    ]


def test_wrong_uses_are_refused_and_harm_nothing(env: BatchEnv):
    step = env.reset()
    rows = env.rows
    for use, message in refuse(env):
        with pytest.raises(hipg_bench.errors.HipgError) as refusal:
            use()
        assert message in str(refusal.value)
    assert same(rows, env.rows)
    env.step(actions(env, step))


def test_an_environment_refuses_to_go_on_before_its_start_and_after_its_end():
    env = make("hazard_nav-4", 1, threads=1)
    rest = np.zeros((1, 4, 3))
    with pytest.raises(hipg_bench.errors.HipgError, match=r"step\(\) before reset"):
        env.step(rest)
    env.reset()
    env.step(rest)
    env.close()
    for use in (env.reset, lambda: env.step(rest), lambda: env.load_rows(np.array([0]), env.rows)):
        with pytest.raises(hipg_bench.errors.HipgError, match="closed"):
            use()


def test_a_world_waits_for_its_reset_where_autoreset_is_off():
    env = make("hazard_nav-4", 3, threads=1, autoreset=False, horizon=2)
    going_on = make("hazard_nav-4", 3, threads=1, horizon=2)
    rest = np.zeros((3, 4, 3))
    for each in (env, going_on):
        each.reset()
        each.step(rest)
    last, next_one = env.step(rest), going_on.step(rest)
    assert last.truncated.all()
    for told in (last.info, next_one.info):
        assert same(last.observation, told["final_observation"])
        assert same(last.info["state"], told["final_state"])
        assert same(env.rows, told["final_rows"])
    assert same(last.info["episode_id"], np.arange(3))
    with pytest.raises(hipg_bench.errors.HipgError, match="env 0 is waiting for reset"):
        env.step(rest)
    fresh = env.reset(worlds=np.array([2, 0]))
    assert fresh.info["episode_id"].tolist() == [4, 1, 3], "the others keep what they ended with"
    assert fresh.info["elapsed"].tolist() == [0, 2, 0]
    with pytest.raises(hipg_bench.errors.HipgError, match="env 1 is waiting for reset"):
        env.step(rest)
    env.reset(worlds=np.array([1]))
    env.step(rest)


def test_a_reset_in_mid_episode_leaves_the_other_worlds_alone(env: BatchEnv):
    middle = play(env, env.reset(np.arange(4)), 3)[-1]
    rows = env.rows
    step = env.reset(np.array([9]), worlds=np.array([2]))
    assert same(env.reset(worlds=np.empty(0, np.int64)).observation, step.observation), "no world, no change"
    others = np.array([0, 1, 3])
    assert same(step.observation[others], middle.observation[others])
    assert same(env.rows[others], rows[others])
    fresh = make(env.spec, 1, threads=1).reset(np.array([9]))
    assert same(step.observation[[2]], fresh.observation)
    assert same(env.rows[[2]], make_rows(env.spec, 9))


def make_rows(spec: TaskSpec, episode: int) -> np.ndarray:
    """The first row of an episode."""
    alone = make(spec, 1, threads=1)
    alone.reset(np.array([episode]))
    return alone.rows


def test_a_new_seed_counts_episodes_from_the_start(env: BatchEnv):
    play(env, env.reset(), 2)
    step = env.reset(seed=77)
    assert step.info["episode_id"].tolist() == [0, 1, 2, 3]
    assert same(step.observation, make(env.spec, 4, seed=77, threads=1).reset().observation)
    again = env.reset()
    assert again.info["episode_id"].tolist() == [4, 5, 6, 7], "a reset goes on with unused episodes"
