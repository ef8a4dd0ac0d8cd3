"""Walkers under a plank: the bodies of the multi-walker family, composed from their MJCF files."""

from __future__ import annotations

import dataclasses
import functools
import math
from typing import Any

import mujoco
import numpy as np
from jaxtyping import Float

from hipg_bench.families.scene import asset, attach

_RIDGE_GAP = 0.2
"""Ridges under the plank stand this far before and behind each head's middle, m."""


@dataclasses.dataclass(frozen=True)
class Body:
    """What the code must know of a walker's MJCF file, read from that file.

    The coordinates of a world are N walkers and then the plank; those of a walker its root and
    then two legs of L joints.

    Attributes:
        file: its name in ``assets/``.
        planar: root of 2 slides and a hinge, instead of a free joint.
        stance: (2, L) joint angles of the legs at which the servos rest at zero input, rad.
        servo: (L,) whether the joint is driven.
        hip: (2, 3) hips in the torso's frame, m.
        thigh, shin: lengths, m.
        sole: middle of the sole from the ankle (the shin's end), m.
        sole_size: half extents of the sole along x and y, m.
        sole_radius: of the ball that is the sole where there is no foot, m.
        head_top: height of the head's upper edge above the torso's origin, m.
        plank_rest: height of the plank's origin above the torso's when it rests on the head, m.
    """

    file: str
    planar: bool
    stance: np.ndarray
    servo: np.ndarray
    hip: np.ndarray
    thigh: float
    shin: float
    sole: np.ndarray
    sole_size: np.ndarray
    sole_radius: float
    head_top: float
    plank_rest: float

    @property
    def joints(self) -> int:
        """L, of a leg."""
        return self.stance.shape[1]

    @property
    def root_q(self) -> int:
        """Generalised positions of a free body."""
        return 3 if self.planar else 7

    @property
    def root_v(self) -> int:
        """Generalised velocities of a free body."""
        return 3 if self.planar else 6

    @functools.cached_property
    def height(self) -> float:
        """Of the torso's origin above the ground in the stance, m."""
        return -min(sole_height(self, leg, 0.0, 0.0, 1.0, self.stance[leg]) for leg in range(2))


@functools.cache
def body_of(planar: bool) -> Body:
    """Read the spatial or the planar walker."""
    file = "walker_planar.xml" if planar else "walker.xml"
    walker = asset(file)
    joints = [joint.name for joint in walker.joints if joint.name.startswith(("left_", "right_"))]
    rest = {motor.target: -motor.biasprm[0] / motor.biasprm[1] for motor in walker.actuators}
    servo = [name in rest for name in joints[: len(joints) // 2]]
    for side in ("left", "right"):
        # the ankle holds the foot level in the stance
        rest[f"{side}_ankle"] = rest[f"{side}_knee"] - rest[f"{side}_hip"]
    foot, head, board = walker.geom("left_foot"), walker.geom("head"), asset("plank.xml").geom("board")
    head_top = float(head.fromto[2] + head.size[0])
    flat = foot.type == mujoco.mjtGeom.mjGEOM_BOX
    ankle = walker.body("left_foot").pos if flat else foot.pos
    sole = foot.pos - np.array([0.0, 0.0, foot.size[2]]) if flat else np.zeros(3)
    return Body(
        file=file,
        planar=planar,
        stance=np.array([rest[name] for name in joints]).reshape(2, -1),
        servo=np.array(servo),
        hip=np.stack([walker.body(f"{side}_thigh").pos for side in ("left", "right")]),
        thigh=float(-walker.body("left_shin").pos[2]),
        shin=float(-ankle[2]),
        sole=sole,
        sole_size=foot.size[:2].copy() if flat else np.zeros(2),
        sole_radius=0.0 if flat else float(foot.size[0]),
        head_top=head_top,
        plank_rest=head_top + float(board.size[2] - board.pos[2]),
    )


def sole_height(legs: Any, leg: int, x: float, y: float, z: float, joint: Float[np.ndarray, "L"]) -> float:
    """Height of a foot's lowest point above the torso's origin, m.

    Args:
        legs: a `Body`, or a record of numbers with what it holds.
        leg: 0 the left one, 1 the right one.
        x: height of the tip of the torso's x axis above its origin, and likewise
        y: of its y axis, and
        z: of its z axis.
        joint: angles of the leg, rad.
    """
    hip = x * legs.hip[leg, 0] + y * legs.hip[leg, 1] + z * legs.hip[leg, 2]
    first = 0 if legs.planar else 1
    if not legs.planar:
        # outwards is a turn about +x for the left leg, about -x for the right one
        turn = joint[0] if leg == 0 else -joint[0]
        cosine, sine = math.cos(turn), math.sin(turn)
        y, z = y * cosine + z * sine, z * cosine - y * sine
    thigh = joint[first]
    # a pitch p lifts the toes: in the leg's plane the foot's axes are (cos p, sin p) and (-sin p, cos p)
    foot = thigh - joint[first + 1]
    ankle = hip + legs.thigh * (x * math.sin(thigh) - z * math.cos(thigh))
    ankle += legs.shin * (x * math.sin(foot) - z * math.cos(foot))
    if not legs.planar:
        foot += joint[3]
    ahead = x * math.cos(foot) + z * math.sin(foot)
    up = z * math.cos(foot) - x * math.sin(foot)
    middle = ankle + legs.sole[0] * ahead + legs.sole[2] * up
    return middle - legs.sole_size[0] * abs(ahead) - legs.sole_size[1] * abs(y) - legs.sole_radius


def plank_corners(num_agents: int, spacing: float, overhang: float) -> Float[np.ndarray, "8 3"]:
    """Of the box around board and rails, in the plank's frame, m."""
    plank = asset("plank.xml")
    board, rail = plank.geom("board"), plank.geom("left_rail")
    x, y = half_length(num_agents, spacing, overhang), board.size[1]
    low, high = rail.pos[2] - rail.size[2], board.pos[2] + board.size[2]
    return np.array([(sx * x, sy * y, z) for sx in (-1, 1) for sy in (-1, 1) for z in (low, high)])


def half_length(num_agents: int, spacing: float, overhang: float) -> float:
    """Of the plank, m."""
    return spacing * (num_agents - 1) / 2 + overhang


def seats(num_agents: int, spacing: float) -> Float[np.ndarray, "N"]:
    """Where each head rests along the plank, from its middle, m; walker N - 1 goes first."""
    return (np.arange(num_agents) - (num_agents - 1) / 2) * spacing


def walker_scene(body: Body, num_agents: int, spacing: float, overhang: float, mass: float) -> mujoco.MjSpec:
    """N walkers in a row along x under a plank.

    Walker i's names are prefixed ``walker<i>/``, the plank's ``plank/``; its actuators are group i.

    Args:
        body: the walker.
        num_agents: N.
        spacing: between neighbours, m.
        overhang: of the plank beyond the outermost heads, m.
        mass: of the plank, kg.
    """
    scene = asset("arena.xml")
    scene.option.iterations = scene.option.ls_iterations = 8
    scene.geom("floor").contype = 1
    size = half_length(num_agents, spacing, overhang) / 1.55
    # shadows are cast within the extent
    scene.stat.extent *= size
    top, overview = scene.camera("top"), scene.camera("overview")
    top.pos = top.pos * size
    # from the side, or the plank hides its carriers
    overview.pos = np.array([0.0, -3.4 * size, 0.45 + 0.3 * size])
    overview.alt.xyaxes = np.array([1.0, 0.0, 0.0, 0.0, 0.09, 0.996])
    for i, seat in enumerate(seats(num_agents, spacing).tolist()):
        walker = asset(body.file)
        _stand(walker, "torso", (seat, 0.0, body.height))
        for motor in walker.actuators:
            motor.group = i
        attach(scene, walker, f"walker{i}/")
    plank = _plank(num_agents, spacing, overhang, mass)
    if body.planar:
        _hold_to_plane(plank)
    _stand(plank, "plank", (0.0, 0.0, body.height + body.plank_rest))
    attach(scene, plank, "plank/")
    return scene


def _stand(part: mujoco.MjSpec, name: str, place: tuple[float, float, float]) -> None:
    """Put a part's root at a place, such that slides read the place itself."""
    root = part.body(name)
    root.pos = np.array(place)
    for joint in root.joints:
        if joint.type == mujoco.mjtJoint.mjJNT_SLIDE:
            joint.ref = float(np.dot(joint.axis, place))


def _plank(num_agents: int, spacing: float, overhang: float, mass: float) -> mujoco.MjSpec:
    """The plank for N heads, a ridge before and behind each."""
    plank = asset("plank.xml")
    half = half_length(num_agents, spacing, overhang)
    for name in ("board", "left_rail", "right_rail"):
        plank.geom(name).size[0] = half
    plank.geom("board").mass = mass
    follow = plank.camera("follow")
    follow.pos = follow.pos * half
    ridge = plank.geom("ridge")
    for i, seat in enumerate(seats(num_agents, spacing).tolist()):
        for name, shift in ((f"ridge{i}_back", -_RIDGE_GAP), (f"ridge{i}_front", _RIDGE_GAP)):
            plank.body("plank").add_geom(
                ridge.classname, name=name, type=ridge.type, size=ridge.size,
                pos=ridge.pos + np.array([seat + shift, 0.0, 0.0]),
            )  # fmt: skip
    plank.delete(ridge)
    return plank


def _hold_to_plane(plank: mujoco.MjSpec) -> None:
    """Let a part with a free root move in the sagittal plane only."""
    body = plank.body("plank")
    plank.delete(plank.joint("root"))
    slide, hinge = mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_HINGE
    for name, kind, axis in (("x", slide, (1, 0, 0)), ("z", slide, (0, 0, 1)), ("pitch", hinge, (0, 1, 0))):
        body.add_joint(name=name, type=kind, axis=axis)
