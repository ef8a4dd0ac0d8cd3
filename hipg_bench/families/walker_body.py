"""Walkers under a plank: the bodies of the multi-walker family, and where they are.

Everything is read from generalised coordinates, which do not lag behind the physics; so no derived
field of MuJoCo is needed, and a saved row says all.
"""

from __future__ import annotations

import dataclasses
import functools

import mujoco
import numpy as np
from jaxtyping import Float, Int

from hipg_bench.families.family import EVERY, Rows
from hipg_bench.families.scene import asset, attach
from hipg_bench.sim import Sim

_RIDGE_GAP = 0.2
"""Ridges under the plank stand this far before and behind each head's middle, m."""
_JOINT_SPREAD = 0.04
"""Servo joints start this near the stance, rad."""
_PLACE_SPREAD = 0.02
"""Bodies start this near their place, m and rad."""
_SPEED_SPREAD = 0.1
"""Torsos start with up to this speed along each axis, m/s and rad/s."""


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
        return float(-sole_height(self, np.eye(3), self.stance).min())


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


@dataclasses.dataclass(frozen=True)
class Pose:
    """Where everything is and how it moves; of the M = N + 1 free bodies the plank is the last.

    Worlds are the first axis, yet the last in memory: so each operation sweeps over all worlds in one go,
    which is several times faster than with short last axes.
    """

    position: Float[np.ndarray, "n M 3"]  # m, world
    rotation: Float[np.ndarray, "n M 3 3"]  # body to world
    velocity: Float[np.ndarray, "n M 3"]  # m/s, world
    spin: Float[np.ndarray, "n M 3"]  # rad/s, own frame
    joint: Float[np.ndarray, "n N 2 L"]  # rad
    joint_rate: Float[np.ndarray, "n N 2 L"]  # rad/s


def pose(body: Body, sim: Sim, rows: Rows = EVERY) -> Pose:
    """Read all bodies, as copies."""
    root, joint = _parts(sim.position[rows], body.root_q, body.joints)
    rate, joint_rate = _parts(sim.velocity[rows], body.root_v, body.joints)
    legs = joint.transpose(3, 0, 1, 2), joint_rate.transpose(3, 0, 1, 2)
    if not body.planar:
        position, rotation, velocity, spin = root[:3], _matrix(root[3:]), rate[:3], rate[3:]
    else:
        position, velocity, spin = (np.zeros(root.shape) for _ in range(3))
        position[::2], velocity[::2], spin[1] = root[:2], rate[:2], rate[2]
        rotation = _pitched(root[2])
    vectors = (position.T, rotation.transpose(3, 2, 0, 1), velocity.T, spin.T)
    return Pose(*vectors, *legs)


def _parts(
    coordinates: Float[np.ndarray, "n C"], root: int, joints: int
) -> tuple[Float[np.ndarray, "R M n"], Float[np.ndarray, "N 2 L n"]]:
    """Coordinates of all free bodies' roots, and of all legs."""
    every = np.ascontiguousarray(coordinates.T)
    walkers = every[:-root].reshape(-1, root + 2 * joints, every.shape[1])
    roots = np.concatenate([walkers[:, :root], every[None, -root:]])
    return roots.transpose(1, 0, 2), walkers[:, root:].reshape(len(walkers), 2, joints, -1)


def _matrix(quaternion: Float[np.ndarray, "4 *lead"]) -> Float[np.ndarray, "3 3 *lead"]:
    """Rotation matrices of quaternions (w, x, y, z), normalised here."""
    unit = quaternion / np.sqrt(np.add.reduce(quaternion * quaternion))
    (_, wx, wy, wz), (_, xx, xy, xz), (_, _, yy, yz), (_, _, _, zz) = 2 * unit[:, None] * unit
    matrix = [
        1 - (yy + zz), xy - wz, xz + wy,
        xy + wz, 1 - (xx + zz), yz - wx,
        xz - wy, yz + wx, 1 - (xx + yy),
    ]  # fmt: skip
    return np.concatenate(matrix).reshape(3, 3, *unit.shape[1:])


def _pitched(angle: Float[np.ndarray, "*lead"]) -> Float[np.ndarray, "3 3 *lead"]:
    """Rotation matrices of turns about the y axis."""
    matrix = np.zeros((3, 3, *angle.shape))
    matrix[0, 0] = matrix[2, 2] = np.cos(angle)
    matrix[0, 2], matrix[1, 1] = np.sin(angle), 1
    matrix[2, 0] = -matrix[0, 2]
    return matrix


def sole_height(
    body: Body, rotation: Float[np.ndarray, "*#lead 3 3"], joint: Float[np.ndarray, "*#lead 2 L"]
) -> Float[np.ndarray, "... 2"]:
    """Height of each foot's lowest point above the torso's origin, m.

    Args:
        body: the walker.
        rotation: of the torso, to the world.
        joint: angles, rad.
    """
    x, y, z = (rotation[..., 2, k, None] for k in range(3))  # heights of the torso's axes
    hip = x * body.hip[:, 0] + y * body.hip[:, 1] + z * body.hip[:, 2]
    if body.planar:
        thigh, shin = joint[..., 0], joint[..., 0] - joint[..., 1]
    else:
        # outwards is a turn about +x for the left leg, about -x for the right one
        turn = joint[..., 0] * np.array([1, -1], joint.dtype)
        cosine, sine = np.cos(turn), np.sin(turn)
        y, z = y * cosine + z * sine, z * cosine - y * sine
        thigh, shin = joint[..., 1], joint[..., 1] - joint[..., 2]
    # a pitch p lifts the toes: in the leg's plane the foot's axes are (cos p, sin p) and (-sin p, cos p)
    ankle = hip + body.thigh * (x * np.sin(thigh) - z * np.cos(thigh))
    cosine, sine = np.cos(shin), np.sin(shin)
    ankle += body.shin * (x * sine - z * cosine)
    if not body.planar:
        foot = shin + joint[..., 3]
        cosine, sine = np.cos(foot), np.sin(foot)
    ahead, up = x * cosine + z * sine, z * cosine - x * sine
    middle = ankle + body.sole[0] * ahead + body.sole[2] * up
    return middle - body.sole_size[0] * np.abs(ahead) - body.sole_size[1] * np.abs(y) - body.sole_radius


def chance_size(body: Body, num_agents: int) -> int:
    """Uniform numbers that `place` takes."""
    return num_agents * (2 * int(body.servo.sum()) + 3 + body.root_v) + 3


def place(
    body: Body,
    sim: Sim,
    ids: Int[np.ndarray, "n"],
    chance: Float[np.ndarray, "n K"],
    seat: Float[np.ndarray, "N"],
) -> None:
    """Stand walkers on the ground, nearly in the stance, and lay the plank on their heads.

    Args:
        body: the walker.
        sim: whose worlds ``ids`` are written.
        ids: worlds.
        chance: uniform numbers, `chance_size` of them.
        seat: places along x, m.
    """
    count, agents = len(ids), len(seat)
    draw = 2 * chance - 1
    per_walker = draw[:, :-3].reshape(count, agents, -1)
    servos = 2 * int(body.servo.sum())
    joint = np.tile(body.stance, (count, agents, 1, 1))
    joint[..., body.servo] += _JOINT_SPREAD * per_walker[..., :servos].reshape(count, agents, 2, -1)
    if not body.planar:
        joint[..., 3] = joint[..., 2] - joint[..., 1]  # feet level
    x, y, yaw = np.moveaxis(_PLACE_SPREAD * per_walker[..., servos : servos + 3], -1, 0)
    # turning about the vertical lifts no foot
    ground = -sole_height(body, np.eye(3), joint).min(axis=-1)
    board_x, board_y, board_yaw = np.moveaxis(_PLACE_SPREAD * draw[:, None, -3:], -1, 0)
    board_z = ground.max(axis=1, keepdims=True) + body.plank_rest
    root = _root(
        body,
        np.concatenate([seat + x, board_x], axis=1),
        np.concatenate([y, board_y], axis=1),
        np.concatenate([ground, board_z], axis=1),
        np.concatenate([yaw, board_yaw], axis=1),
    )
    walker_q = np.concatenate([root[:, :-1], joint.reshape(count, agents, -1)], axis=-1)
    sim.position[ids] = np.concatenate([walker_q.reshape(count, -1), root[:, -1]], axis=1)
    speed = _SPEED_SPREAD * per_walker[..., servos + 3 :]
    walker_v = np.concatenate([speed, np.zeros((count, agents, 2 * body.joints))], axis=-1).reshape(count, -1)
    sim.velocity[ids] = 0.0
    sim.velocity[ids, : walker_v.shape[1]] = walker_v


def _root(
    body: Body,
    x: Float[np.ndarray, "n M"],
    y: Float[np.ndarray, "n M"],
    z: Float[np.ndarray, "n M"],
    yaw: Float[np.ndarray, "n M"],
) -> Float[np.ndarray, "n M R"]:
    """Generalised positions of upright free bodies; in the plane there is neither y nor yaw."""
    zero = np.zeros_like(x)
    if body.planar:
        return np.stack([x, z, zero], axis=-1)
    return np.stack([x, y, z, np.cos(yaw / 2), zero, zero, np.sin(yaw / 2)], axis=-1)
