"""Walkers and plank against plain MuJoCo."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from walkers import PLANAR, ROW, SPATIAL, lowest_corner, put, read, root, world

from hipg_bench import make

BOTH = pytest.mark.parametrize("task", [SPATIAL, PLANAR])


def planks(env):
    """Places (B, 3), m, and speeds (B, 3), m/s, of all planks."""
    scratches = [read(env, k).scratch for k in range(env.num_envs)]
    return np.array([one.place[-1] for one in scratches]), np.array([one.speed[-1] for one in scratches])


@BOTH
def test_what_is_read_is_what_mujoco_derives(task: str):
    env = make(task, 20, threads=1)
    env.reset()
    rng = np.random.default_rng(3)
    for k in range(20):
        data = world(env, k)
        data.qpos += rng.normal(0, 0.4, env.model.nq)
        data.qvel = rng.normal(0, 1, env.model.nv)
        mujoco.mj_normalizeQuat(env.model, data.qpos)
        put(env, data, k)
    joints = env.layout.state.view(env.arrange().info["state"], "joint")
    for k in range(20):
        data, now = world(env, k), read(env, k).scratch
        bodies = ["walker0/torso", "walker1/torso", "walker2/torso", "plank/plank"]
        for i, body in enumerate(bodies):
            np.testing.assert_allclose(now.place[i], data.body(body).xpos, atol=1e-12)
            np.testing.assert_allclose(now.turn[i].ravel(), data.body(body).xmat, atol=1e-12)
            velocity = np.empty(6)
            kind, index = mujoco.mjtObj.mjOBJ_XBODY, env.model.body(body).id
            mujoco.mj_objectVelocity(env.model, data, kind, index, velocity, 1)
            np.testing.assert_allclose(now.spin[i], velocity[:3], atol=1e-12)
            mujoco.mj_objectVelocity(env.model, data, kind, index, velocity, 0)
            np.testing.assert_allclose(now.speed[i], velocity[3:], atol=1e-12)
        for i in range(3):
            soles = [lowest_corner(data, f"walker{i}/{side}_foot") for side in ("left", "right")]
            assert (now.touch[i] == (np.array(soles) < 0.002)).all()
            joint = [
                data.joint(f"walker{i}/{side}_{name}").qpos[0]
                for side in ("left", "right")
                for name in (("hip", "knee") if task == PLANAR else ("abduction", "hip", "knee", "ankle"))
            ]
            np.testing.assert_array_equal(joints[k, i].ravel(), np.array(joint, np.float32))
        low = min(lowest_corner(data, f"plank/{name}") for name in ("board", "left_rail", "right_rail"))
        assert now.plank_low == pytest.approx(low, abs=1e-12)


@BOTH
def test_feet_that_carry_weight_touch(task: str):
    env = make(task, 8, threads=1)
    env.reset()
    rng = np.random.default_rng(0)
    loaded = lifted = 0
    for _ in range(40):
        env.step(rng.uniform(-1, 1, (8, 3, env.action_size)))
        for k in range(8):
            data, now = world(env, k), read(env, k).scratch
            for i in range(3):
                for leg, side in enumerate(("left", "right")):
                    name = f"walker{i}/{side}_foot"
                    touches = any(
                        env.model.geom(name).id in (contact.geom1, contact.geom2) for contact in data.contact
                    )
                    clear = lowest_corner(data, name) > 0.01
                    assert not (touches and not now.touch[i, leg])
                    assert not (clear and now.touch[i, leg])
                    loaded += touches
                    lifted += clear
    assert loaded > 100
    assert lifted > 100


@BOTH
def test_the_plank_rests_on_standing_walkers(task: str):
    env = make(task, 256, threads=1)
    env.reset()
    start = planks(env)[0]
    for _ in range(100):  # 2 s
        step = env.step(np.zeros((256, 3, env.action_size)))
        assert not step.terminated.any()
    assert step.info["alive"].all()
    place, speed = planks(env)
    moved = place - start
    assert np.abs(moved[:, :2]).max() < 0.1
    # the heads give way under the weight and by the spread of the starts, no more
    assert np.abs(moved[:, 2]).max() < 0.05
    assert np.linalg.norm(speed, axis=1).max() < 0.2


@pytest.mark.parametrize("task", [SPATIAL, PLANAR, "multiwalker-5"])
def test_fifty_steps_are_those_of_plain_mujoco(task: str):
    env = make(task, 2, threads=2)
    env.reset()
    data = world(env, 1)
    mujoco.mj_setState(env.model, data, env.rows[1], ROW)
    rng = np.random.default_rng(1)
    for _ in range(50):
        action = 0.3 * rng.uniform(-1, 1, (2, env.num_agents, env.action_size))
        step = env.step(action)
        assert step.info["alive"].all()
        data.ctrl = action[1].ravel()
        for _ in range(env.decimation):
            mujoco.mj_step(env.model, data)
        assert data.qpos.tobytes() == env.get_field("coordinate")[1].tobytes()
        assert data.qvel.tobytes() == env.get_field("rate")[1].tobytes()


@BOTH
def test_the_dead_are_limp_and_the_others_are_not(task: str):
    env = make(task, 1, threads=1)
    env.reset()
    data = world(env)
    data.ctrl = 1.0
    env.model.opt.disableactuator = 1 << 1
    mujoco.mj_forward(env.model, data)
    env.model.opt.disableactuator = 0
    for actuator in range(env.model.nu):
        dead = env.model.actuator(actuator).name.startswith("walker1/")
        assert (data.actuator_force[actuator] == 0) == dead
        dof = env.model.jnt_dofadr[env.model.actuator_trnid[actuator, 0]]
        assert (data.qfrc_actuator[dof] == 0) == dead


def test_a_limp_walker_sinks_under_the_plank_whatever_it_is_told():
    heights: list[bytes] = []
    for told in (-1.0, 0.0, 1.0):
        env = make(SPATIAL, 1, threads=1)
        env.reset()
        env.load_rows(np.array([0]), env.fork(env.rows, {1: 0.0}))
        action = np.zeros((1, 3, 6))
        action[0, 1] = told
        for _ in range(60):
            step = env.step(action)
            assert step.info["terms"]["fall"][0] == 0  # a death that is no fall is not charged
        heights.append(env.rows.tobytes())
        torso = world(env).body("walker1/torso").xpos[2]
        assert torso < 0.3
        assert step.info["alive"][0].tolist() == [True, False, True]
    assert len(set(heights)) == 1


def test_bodies_meet_what_they_should():
    env = make(SPATIAL, 1, threads=1)
    env.reset()
    for _ in range(25):
        env.step(np.zeros((1, 3, 6)))

    def pairs(data: mujoco.MjData) -> set[frozenset[str]]:
        names = [env.model.geom(k).name for k in range(env.model.ngeom)]
        return {frozenset((names[c.geom1], names[c.geom2])) for c in data.contact}

    standing = {
        frozenset((f"walker{i}/{side}_foot", "floor")) for i in range(3) for side in ("left", "right")
    }
    carrying = {frozenset((f"walker{i}/head", "plank/board")) for i in range(3)}
    assert pairs(world(env)) == standing | carrying
    data = world(env)
    # walker 0 lies down across the feet of walker 1, and the plank is elsewhere
    root(env, data, "walker0")[:3] = root(env, data, "walker1")[:3] - [0.05, 0.0, 0.5]
    root(env, data, "plank")[2] = 3.0
    mujoco.mj_forward(env.model, data)
    met = pairs(data)
    assert any("walker0/torso" in pair and "walker1/left_foot" in pair for pair in met)
    for pair in met:
        owners = {name.split("/")[0] for name in pair}
        assert len(owners) == 2, f"{pair} belong to one body"


@pytest.mark.parametrize("n", [2, 7, 31])
def test_the_plank_follows_the_number_of_walkers(n: int):
    env = make(SPATIAL, 1, threads=1, num_agents=n)
    step = env.reset()
    assert env.model.geom("plank/board").size[0] == pytest.approx(0.6 * (n - 1) + 0.35)
    assert env.model.body("plank/plank").mass[0] == pytest.approx(n)
    for i in range(n):
        torso = env.model.body(f"walker{i}/torso").pos[0]
        assert torso == pytest.approx(1.2 * i - 0.6 * (n - 1))
        for name, shift in (("back", -0.2), ("front", 0.2)):
            assert env.model.geom(f"plank/ridge{i}_{name}").pos[0] == pytest.approx(torso + shift)
    for _ in range(10):
        step = env.step(np.zeros((1, n, 6)))
    assert step.info["alive"].all()
    assert np.isfinite(step.observation).all()
