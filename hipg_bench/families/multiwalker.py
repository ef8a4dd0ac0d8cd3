"""Multi-walker: N bipeds carry one plank on their heads.

Agents: walkers in a row, each with servos in its legs; the plank lies free on their heads, kept from sliding
by ridges and rails. Reward: the plank's way forward, up to a rewarded speed. Hazard: a walker that tips over
or sinks down goes limp for good, lies in the way, and leaves its share of the plank to the others. End: when
the plank touches the ground, when all walkers fell, or at the horizon.

Everything is read from generalised coordinates, which do not lag behind the physics: no derived field of
MuJoCo is needed, and a saved row says all.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import mujoco
import numpy as np
import pydantic
from jaxtyping import Bool, Float, Int

from hipg_bench.families import family, walker_body
from hipg_bench.families.walker_body import sole_height
from hipg_bench.layout import SHARE, UNIT, Block, Layout, TaskLayout
from hipg_bench.mechanics.geometry import mean
from hipg_bench.spec import Params as BaseParams
from hipg_bench.spec import TaskSpec

_PHYSICS_STEP = 0.01
"""Seconds per physics step."""
TOUCH = 0.002
"""A foot whose sole is lower than this touches the ground, m."""
JOINT_SPREAD = 0.04
"""Servo joints start this near the stance, rad."""
PLACE_SPREAD = 0.02
"""Bodies start this near their place, m and rad."""
SPEED_SPREAD = 0.1
"""Torsos start with up to this speed along each axis, m/s and rad/s."""
TIPPED, SUNK = 0, 1
DROPPED, ALL_FALLEN = 3, 4

PHYSICS = {"QPOS": ("coordinate",), "QVEL": ("rate",), "CTRL": ("control",)}
CAUSES = ("tipped", "sunk")
REASONS = ("dropped", "all_fallen")
RENDERING = "hipg_bench.rendering.walkers:Carrying"


class Params(BaseParams):
    """Numbers of multi-walker.

    Attributes:
        planar: walkers and plank move in the sagittal plane only, with 4 servos per walker instead of 6.
        spacing: between the seats of neighbours, m.
        overhang: of the plank beyond the outermost seats, m.
        plank_mass: kg per walker.
        speed_cap: faster progress is not rewarded, m/s.
        upright: a torso whose up-axis has a smaller vertical part has tipped over.
        sunk: a torso lower than this share of its standing height has sunk down.
        fall_steps: control steps in a row tipped or sunk that make a fall.
        drop_height: a plank whose lowest corner is lower is on the ground, m.
    """

    planar: bool
    spacing: float = pydantic.Field(ge=0.6, le=5)
    overhang: float = pydantic.Field(ge=0.25, le=2)
    plank_mass: float = pydantic.Field(gt=0, le=10)
    speed_cap: float = pydantic.Field(gt=0, le=10)
    upright: float = pydantic.Field(ge=0, lt=1)
    sunk: float = pydantic.Field(ge=0, lt=1)
    fall_steps: int = pydantic.Field(ge=1, le=100)
    drop_height: float = pydantic.Field(ge=0, le=0.5)


class World(family.World):
    """What evolves."""

    coordinate: Float[np.ndarray, "Q"]  # of each walker its root and two legs, then of the plank its root
    rate: Float[np.ndarray, "V"]
    control: Float[np.ndarray, "N A"]  # servo targets, the last action
    down: Float[np.ndarray, "N"]  # control steps in a row tipped or sunk
    displacement: float  # of the plank, m
    slip: float  # of the plank over its live carriers, m


class Previous(family.Previous):
    """What a control step is compared with."""

    x: Float[np.ndarray, "M"]  # of the walkers and the plank, m
    control: Float[np.ndarray, "N A"]


class Scratch(family.Scratch):
    """Where everything is and how it moves; of the M = N + 1 free bodies the plank is the last."""

    place: Float[np.ndarray, "M 3"]  # m, world
    turn: Float[np.ndarray, "M 3 3"]  # body to world
    speed: Float[np.ndarray, "M 3"]  # m/s, world
    spin: Float[np.ndarray, "M 3"]  # rad/s, own frame
    touch: Bool[np.ndarray, "N 2"]  # feet on the ground
    plank_low: float  # height of the plank's lowest corner, m
    square: Float[np.ndarray, "N*A"]


class Numbers(family.Numbers):
    """Numbers of the task, see `Params`, and of the body, see `walker_body.Body`."""

    planar: bool
    spacing: float
    speed_cap: float
    upright: float
    sunk: float
    fall_steps: float
    drop_height: float
    height: float
    head_top: float
    plank_rest: float
    hip: Float[np.ndarray, "2 3"]
    thigh: float
    shin: float
    sole: Float[np.ndarray, "3"]
    sole_size: Float[np.ndarray, "2"]
    sole_radius: float
    stance: Float[np.ndarray, "2 L"]
    servo: Bool[np.ndarray, "L"]
    root_q: int
    root_v: int
    seats: Float[np.ndarray, "N"]  # along the plank, from its middle, m
    corners: Float[np.ndarray, "8 3"]  # of the plank, in its frame, m
    axes: Int[np.ndarray, "D"]  # along which vectors are observed: x, y and z, or x and z
    turns: Int[np.ndarray, "U"]  # about which turning is observed
    lie_row: Int[np.ndarray, "U"]  # entries of the plank's rotation that tell how it lies
    lie_column: Int[np.ndarray, "U"]


class Terms(family.Terms):
    """Parts of the team reward, before weights."""

    progress: float  # the plank's way along x, m, at most the capped speed's
    fall: float  # share of the team that fell in the step
    drop: float  # 1 where the plank is lost: on the ground, or with nobody left under it
    effort: float  # mean square of the actions
    jerk: float  # mean square of their change
    alive: float  # share on its feet; tasks do not pay for it, but training may: standing must earn nothing


class Metrics(family.Metrics):
    """Of an episode."""

    displacement: float  # of the plank, m
    slip: float  # of it, over its live carriers, m
    carriers: float  # alive at the end
    tipped: float  # walkers that tipped over
    sunk: float  # walkers that sank down
    dropped: float  # 1 where the plank is on the ground at the end


# --- rules, in the order of a step ---------------------------------------------------------------------


def begin(w: World, scratch: Scratch, task: Numbers, random: Float[np.ndarray, "C"]) -> None:
    """Walkers stand nearly in the stance, the plank lies nearly in its place on their heads."""
    agents, joints, k = len(w.health), len(task.servo), 0
    highest = -math.inf
    for i in range(agents):
        root = i * (task.root_q + 2 * joints)
        leg, lowest = root + task.root_q, math.inf
        for side in range(2):
            for joint in range(joints):
                w.coordinate[leg + joint] = task.stance[side, joint]
                if task.servo[joint]:
                    w.coordinate[leg + joint] += JOINT_SPREAD * (2 * random[k] - 1)
                    k += 1
            if not task.planar:  # feet level
                w.coordinate[leg + 3] = w.coordinate[leg + 2] - w.coordinate[leg + 1]
            # turning about the vertical lifts no foot
            angle = w.coordinate[leg : leg + joints]
            lowest = min(lowest, sole_height(task, side, 0.0, 0.0, 1.0, angle))
            leg += joints
        highest = max(highest, -lowest)
        put(w.coordinate, task, root, task.seats[i], -lowest, random[k:])
        k += 3
        for axis in range(task.root_v):
            w.rate[i * (task.root_v + 2 * joints) + axis] = SPEED_SPREAD * (2 * random[k] - 1)
            k += 1
    put(w.coordinate, task, agents * (task.root_q + 2 * joints), 0.0, highest + task.plank_rest, random[k:])


def put(
    coordinate: Float[np.ndarray, "Q"],
    task: Numbers,
    root: int,
    x: float,
    z: float,
    random: Float[np.ndarray, "C"],
) -> None:
    """Put an upright free body near a place; in the plane there is neither y nor yaw."""
    x += PLACE_SPREAD * (2 * random[0] - 1)
    if task.planar:
        coordinate[root], coordinate[root + 1], coordinate[root + 2] = x, z, 0.0
        return
    half = PLACE_SPREAD * (2 * random[2] - 1) / 2
    coordinate[root], coordinate[root + 1], coordinate[root + 2] = x, PLACE_SPREAD * (2 * random[1] - 1), z
    coordinate[root + 3], coordinate[root + 6] = math.cos(half), math.sin(half)
    coordinate[root + 4], coordinate[root + 5] = 0.0, 0.0


def act(
    w: World, previous: Previous, scratch: Scratch, task: Numbers, command: Float[np.ndarray, "N A"]
) -> None:
    """Servo targets, around the stance."""
    agents, servos = command.shape
    for m in range(agents + 1):
        previous.x[m] = w.coordinate[m * (task.root_q + 2 * len(task.servo))]
    for i in range(agents):
        for k in range(servos):
            previous.control[i, k] = w.control[i, k]
            w.control[i, k] = command[i, k]


def read(w: World, scratch: Scratch, task: Numbers) -> None:
    """Work out where all bodies are, and how low the plank hangs."""
    agents, legs = len(w.health), 2 * len(task.servo)
    coordinate, rate = w.coordinate, w.rate
    place, turn, speed, spin = scratch.place, scratch.turn, scratch.speed, scratch.spin
    for m in range(agents + 1):
        root, moves = m * (task.root_q + legs), m * (task.root_v + legs)
        if task.planar:
            place[m, 0], place[m, 1], place[m, 2] = coordinate[root], 0.0, coordinate[root + 1]
            speed[m, 0], speed[m, 1], speed[m, 2] = rate[moves], 0.0, rate[moves + 1]
            spin[m, 0], spin[m, 1], spin[m, 2] = 0.0, rate[moves + 2], 0.0
            pitch(turn[m], coordinate[root + 2])
        else:
            for axis in range(3):
                place[m, axis], speed[m, axis] = coordinate[root + axis], rate[moves + axis]
                spin[m, axis] = rate[moves + 3 + axis]
            rotate(turn[m], coordinate[root + 3 : root + 7])
    lowest = math.inf
    for k in range(len(task.corners)):
        x, y = turn[agents, 2, 0] * task.corners[k, 0], turn[agents, 2, 1] * task.corners[k, 1]
        lowest = min(lowest, x + y + turn[agents, 2, 2] * task.corners[k, 2])
    scratch.plank_low = place[agents, 2] + lowest


def rotate(turn: Float[np.ndarray, "3 3"], quaternion: Float[np.ndarray, "4"]) -> None:
    """Write the rotation matrix of a quaternion (w, x, y, z), normalised here."""
    w, x, y, z = quaternion[0], quaternion[1], quaternion[2], quaternion[3]
    size = math.sqrt(w * w + x * x + y * y + z * z)
    w, x, y, z = w / size, x / size, y / size, z / size
    wx, wy, wz = 2 * w * x, 2 * w * y, 2 * w * z
    xx, xy, xz = 2 * x * x, 2 * x * y, 2 * x * z
    yy, yz, zz = 2 * y * y, 2 * y * z, 2 * z * z
    turn[0, 0], turn[0, 1], turn[0, 2] = 1 - (yy + zz), xy - wz, xz + wy
    turn[1, 0], turn[1, 1], turn[1, 2] = xy + wz, 1 - (xx + zz), yz - wx
    turn[2, 0], turn[2, 1], turn[2, 2] = xz - wy, yz + wx, 1 - (xx + yy)


def pitch(turn: Float[np.ndarray, "3 3"], angle: float) -> None:
    """Write the rotation matrix of a turn about the y axis."""
    cosine, sine = math.cos(angle), math.sin(angle)
    turn[0, 0], turn[0, 1], turn[0, 2] = cosine, 0.0, sine
    turn[1, 0], turn[1, 1], turn[1, 2] = 0.0, 1.0, 0.0
    turn[2, 0], turn[2, 1], turn[2, 2] = -sine, 0.0, cosine


def harm(w: World, previous: Previous, scratch: Scratch, task: Numbers) -> None:
    """Whoever is tipped or sunk for long enough has fallen."""
    for i in range(len(w.health)):
        tipped = scratch.turn[i, 2, 2] < task.upright
        off_feet = tipped or scratch.place[i, 2] < task.sunk * task.height
        w.down[i] = min(w.down[i] + 1, task.fall_steps) if off_feet else 0.0
        scratch.fatal[i] = w.down[i] >= task.fall_steps
        scratch.cause[i] = TIPPED if tipped else SUNK


def update(w: World, previous: Previous, scratch: Scratch, task: Numbers) -> None:
    """Add up the plank's way, and how far it left its live carriers behind."""
    agents, carried, live = len(w.health), 0.0, 0
    for i in range(agents):
        if w.health[i] > 0:
            carried += scratch.place[i, 0] - previous.x[i]
            live += 1
    moved = scratch.place[agents, 0] - previous.x[agents]
    w.displacement += moved
    w.slip += moved - carried / max(live, 1)


def reward(w: World, previous: Previous, scratch: Scratch, task: Numbers, terms: Terms) -> None:
    """Pay for the plank's way forward; charge for falls, a lost plank, and effort."""
    agents, servos = w.control.shape
    fell, live = 0, 0
    for i in range(agents):
        fell += 1 if previous.health[i] > 0 and w.health[i] == 0 else 0
        live += 1 if w.health[i] > 0 else 0
    moved = scratch.place[agents, 0] - previous.x[agents]
    terms.progress = min(moved, task.speed_cap * task.control_step)
    terms.fall, terms.alive = fell / agents, live / agents
    terms.drop = 1.0 if end(w, scratch, task) != 0 else 0.0
    square = scratch.square
    for i in range(agents):
        for k in range(servos):
            square[i * servos + k] = w.control[i, k] * w.control[i, k]
    terms.effort = mean(square)
    for i in range(agents):
        for k in range(servos):
            change = w.control[i, k] - previous.control[i, k]
            square[i * servos + k] = change * change
    terms.jerk = mean(square)


def end(w: World, scratch: Scratch, task: Numbers) -> int:
    """When the plank is on the ground, or nobody is left to carry it."""
    if scratch.plank_low < task.drop_height:
        return DROPPED
    for i in range(len(w.health)):
        if w.health[i] > 0:
            return 0
    return ALL_FALLEN


def survey(w: World, scratch: Scratch, task: Numbers) -> None:
    """Find the feet that touch the ground."""
    joints = len(task.servo)
    for i in range(len(w.health)):
        up = scratch.turn[i, 2]
        for side in range(2):
            leg = i * (task.root_q + 2 * joints) + task.root_q + side * joints
            sole = sole_height(task, side, up[0], up[1], up[2], w.coordinate[leg : leg + joints])
            scratch.touch[i, side] = scratch.place[i, 2] + sole < TOUCH


def observe(w: World, scratch: Scratch, task: Numbers, i: int, seen: Any) -> None:
    """Own body exactly, the plank above one's head, and the neighbours behind and ahead."""
    agents, place, speed, turn = len(w.health), scratch.place, scratch.speed, scratch.turn
    seen.health[0], seen.height[0] = w.health[i], place[i, 2]
    feel(
        w, scratch, task, i, seen.up, seen.heading, seen.velocity, seen.spin, seen.joint, seen.joint_rate,
        seen.touch, seen.action,
    )  # fmt: skip
    for k in range(len(task.axes)):  # the head in the plank's frame, from its seat
        axis, along = task.axes[k], 0.0
        for of in range(3):
            head = place[i, of] + task.head_top * turn[i, of, 2]
            along += (head - place[agents, of]) * turn[agents, of, axis]
        seen.head_on_plank[k] = along - task.seats[i] if axis == 0 else along
    describe_plank(w, scratch, task, seen)
    for side in range(2):
        j = i + 2 * side - 1
        there = 0 <= j < agents
        seen.neighbor_there[side] = 1.0 if there else 0.0
        seen.neighbor_health[side] = w.health[j] if there else 0.0
        for k in range(len(task.axes)):
            axis = task.axes[k]
            beyond = task.spacing * (2 * side - 1) if axis == 0 else 0.0
            seen.neighbor_gap[side, k] = place[j, axis] - place[i, axis] - beyond if there else 0.0
            seen.neighbor_velocity[side, k] = speed[j, axis] - speed[i, axis] if there else 0.0


def feel(
    w: World,
    scratch: Scratch,
    task: Numbers,
    i: int,
    up: Any,
    heading: Any,
    velocity: Any,
    spin: Any,
    joint: Any,
    joint_rate: Any,
    touch: Any,
    action: Any,
) -> None:
    """Write what a walker feels of its own body."""
    turn, speed, joints = scratch.turn, scratch.speed, len(task.servo)
    for k in range(len(task.axes)):
        axis = task.axes[k]
        up[k] = turn[i, 2, axis]
        # from the world into the body's frame
        along = 0.0
        for of in range(3):
            along += speed[i, of] * turn[i, of, axis]
        velocity[k] = along
    for axis in range(len(heading)):
        heading[axis] = turn[i, 0, axis]
    for k in range(len(task.turns)):
        spin[k] = scratch.spin[i, task.turns[k]]
    for side in range(2):
        touch[side] = 1.0 if scratch.touch[i, side] else 0.0
        for k in range(joints):
            leg = side * joints + k
            joint[side, k] = w.coordinate[i * (task.root_q + 2 * joints) + task.root_q + leg]
            joint_rate[side, k] = w.rate[i * (task.root_v + 2 * joints) + task.root_v + leg]
    for k in range(len(action)):
        action[k] = w.control[i, k]


def describe_plank(w: World, scratch: Scratch, task: Numbers, seen: Any) -> None:
    """Write how the plank lies and moves."""
    plank = len(w.health)
    for k in range(len(task.turns)):
        seen.plank_lie[k] = scratch.turn[plank, task.lie_row[k], task.lie_column[k]]
        seen.plank_spin[k] = scratch.spin[plank, task.turns[k]]
    for k in range(len(task.axes)):
        seen.plank_velocity[k] = scratch.speed[plank, task.axes[k]]


def state(w: World, scratch: Scratch, task: Numbers, state: Any) -> None:
    """All bodies, and how long each walker has been off its feet."""
    plank, place = len(w.health), scratch.place
    for i in range(plank):
        state.health[i], state.down[i] = w.health[i], w.down[i]
        feel(
            w, scratch, task, i, state.up[i], state.heading[i], state.velocity[i], state.spin[i],
            state.joint[i], state.joint_rate[i], state.touch[i], state.action[i],
        )  # fmt: skip
        for k in range(len(task.axes)):
            beyond = place[i, task.axes[k]] - place[plank, task.axes[k]]
            state.place[i, k] = beyond - task.seats[i] if k == 0 else beyond
    for k in range(len(task.axes)):
        state.plank_position[k] = place[plank, task.axes[k]]
    describe_plank(w, scratch, task, state)


def metrics(w: World, scratch: Scratch, task: Numbers, metrics: Metrics) -> None:
    """Way of the plank, carriers, and falls by cause."""
    metrics.displacement, metrics.slip = w.displacement, w.slip
    metrics.dropped = 1.0 if scratch.plank_low < task.drop_height else 0.0
    metrics.carriers, metrics.tipped, metrics.sunk = 0.0, 0.0, 0.0
    for i in range(len(w.health)):
        if w.health[i] > 0:
            metrics.carriers += 1.0
        elif w.death_cause[i] == TIPPED:
            metrics.tipped += 1.0
        elif w.death_cause[i] == SUNK:
            metrics.sunk += 1.0


# --- declarations --------------------------------------------------------------------------------------


def physics_steps(spec: TaskSpec) -> int:
    """Physics steps per control step."""
    return max(1, round(spec.control_step / _PHYSICS_STEP))


def layout(spec: TaskSpec, params: Params) -> TaskLayout:
    """Walkers feel their own body, the plank and their neighbours; critics see all bodies."""
    n, body = spec.num_agents, walker_body.body_of(params.planar)
    d, there = 2 if params.planar else 3, "where there is one, dead or alive"
    servos = int(body.servo.sum())
    what = "hip, knee" if params.planar else "hip abduction, hip, knee"
    return TaskLayout(
        observation=Layout((
            Block("health", (1,), "1", limits=SHARE),
            Block("height", (1,), "m", "world"),
            *_body_blocks(params, ()),
            Block("head_on_plank", (d,), "m", "plank, from one's seat"),
            *_plank_blocks(params),
            Block("neighbor_there", (2,), "1", "-", "behind, ahead", limits=SHARE),
            Block("neighbor_health", (2,), "1", "-", there, limits=SHARE),
            Block("neighbor_gap", (2, d), "m", "own place, less the seats' spacing", there),
            Block("neighbor_velocity", (2, d), "m/s", "world, relative", there),
        )),
        action=Layout((
            Block("servo_target", (2, servos), f"of the range of left and right {what}", "from the stance"),
        )),
        state=Layout((
            Block("health", (n,), "1", limits=SHARE),
            Block("down", (n,), "control steps off one's feet"),
            Block("place", (n, d), "m", "world, from the plank's middle and one's seat"),
            *_body_blocks(params, (n,)),
            Block("plank_position", (d,), "m", "world"),
            *_plank_blocks(params),
        )),
    )  # fmt: skip


def _body_blocks(params: Params, lead: tuple[int, ...]) -> tuple[Block, ...]:
    body = walker_body.body_of(params.planar)
    d, turns = (2, 1) if params.planar else (3, 3)
    heading = 0 if params.planar else 3
    return (
        Block("up", (*lead, d), "1", "world's z axis in the body's", limits=UNIT),
        Block("heading", (*lead, heading), "1", "world's x axis in the body's", limits=UNIT),
        Block("velocity", (*lead, d), "m/s", "body"),
        Block("spin", (*lead, turns), "rad/s", "body"),
        Block("joint", (*lead, 2, body.joints), "rad"),
        Block("joint_rate", (*lead, 2, body.joints), "rad/s"),
        Block("touch", (*lead, 2), "1"),
        Block("action", (*lead, 2 * int(body.servo.sum())), "1", limits=UNIT),
    )


def _plank_blocks(params: Params) -> tuple[Block, ...]:
    d, turns = (2, 1) if params.planar else (3, 3)
    return (
        Block("plank_lie", (turns,), "1", "sines of pitch, roll and yaw"),
        Block("plank_velocity", (d,), "m/s", "world"),
        Block("plank_spin", (turns,), "rad/s", "plank"),
    )


def scene(spec: TaskSpec, params: Params) -> mujoco.MjSpec:
    """N walkers in a row under a plank."""
    n, body = spec.num_agents, walker_body.body_of(params.planar)
    world = walker_body.walker_scene(body, n, params.spacing, params.overhang, params.plank_mass * n)
    world.option.timestep = spec.control_step / physics_steps(spec)
    return world


def num_random(spec: TaskSpec, params: Params) -> int:
    """Joints, place and speed of each walker; place of the plank."""
    body = walker_body.body_of(params.planar)
    return spec.num_agents * (2 * int(body.servo.sum()) + 3 + body.root_v) + 3


def sizes(spec: TaskSpec, params: Params) -> Mapping[str, int]:
    """Coordinates and rates of all bodies; joints of a leg; observed axes and turns."""
    n, body = spec.num_agents, walker_body.body_of(params.planar)
    legs = 2 * body.joints
    return {
        "Q": n * (body.root_q + legs) + body.root_q, "V": n * (body.root_v + legs) + body.root_v,
        "M": n + 1, "L": body.joints, "D": 2 if params.planar else 3, "U": 1 if params.planar else 3,
    }  # fmt: skip


def numbers(spec: TaskSpec, params: Params) -> Mapping[str, Any]:
    """The family's entries of `Numbers`."""
    n, body = spec.num_agents, walker_body.body_of(params.planar)
    of_task = ("planar", "spacing", "speed_cap", "upright", "sunk", "fall_steps", "drop_height")
    of_body = (
        "height", "head_top", "plank_rest", "hip", "thigh", "shin", "sole", "sole_size", "sole_radius",
        "stance", "servo", "root_q", "root_v",
    )  # fmt: skip
    return {
        **{name: getattr(params, name) for name in of_task},
        **{name: getattr(body, name) for name in of_body},
        "seats": walker_body.seats(n, params.spacing),
        "corners": walker_body.plank_corners(n, params.spacing, params.overhang),
        # in the plane, vectors have x and z only, and turning has y only
        "axes": (0, 2) if params.planar else (0, 1, 2),
        "turns": (1,) if params.planar else (0, 1, 2),
        # the plank's long axis points up by the pitch, aside by the yaw; its side axis points up by the roll
        "lie_row": (2,) if params.planar else (2, 2, 1),
        "lie_column": (0,) if params.planar else (0, 1, 0),
    }
