"""Worlds of the multi-walker in plain MuJoCo: what its tests share."""

from __future__ import annotations

import mujoco
import numpy as np
from one_world import OneWorld

from hipg_bench import BatchEnv

ROW = int(mujoco.mjtState.mjSTATE_INTEGRATION)
SPATIAL, PLANAR = "multiwalker-3", "multiwalker_planar-3"


def world(env: BatchEnv, k: int = 0) -> mujoco.MjData:
    """World k in plain MuJoCo."""
    data = mujoco.MjData(env.model)
    mujoco.mj_setState(env.model, data, env.rows[k], ROW)
    mujoco.mj_forward(env.model, data)
    return data


def put(env: BatchEnv, data: mujoco.MjData, k: int = 0) -> None:
    """Make world k what ``data`` says."""
    row = np.empty_like(env.rows[k])
    mujoco.mj_getState(env.model, data, row, ROW)
    env.load_rows(np.array([k]), row[None])


def root(env: BatchEnv, data: mujoco.MjData, name: str) -> np.ndarray:
    """Live view of the 7 numbers of a free body."""
    return data.joint(f"{name}/root").qpos


def turn(axis: tuple[float, float, float], angle: float) -> np.ndarray:
    quaternion = np.empty(4)
    mujoco.mju_axisAngle2Quat(quaternion, np.array(axis), angle)
    return quaternion


def read(env: BatchEnv, k: int = 0) -> OneWorld:
    """World k, with all bodies and feet read."""
    one = OneWorld(env, k)
    one.read()
    one.call("survey", one.w, one.scratch, one.task)
    return one


def lowest_corner(data: mujoco.MjData, geom: str) -> float:
    """Height of a box's or ball's lowest point."""
    shape = data.geom(geom)
    size = data.model.geom(geom).size
    if data.model.geom(geom).type == mujoco.mjtGeom.mjGEOM_SPHERE:
        return float(shape.xpos[2] - size[0])
    return float(shape.xpos[2] - np.abs(shape.xmat.reshape(3, 3)[2]) @ size)
