"""Multi-walker: N bipeds carry one plank on their heads.

Who: walkers in a row, each with servos in its legs; the plank lies free on their heads, kept from
sliding by ridges and rails. What pays: the plank's way forward, up to a rewarded speed. What
hurts: a walker that tips over or sinks down goes limp for good, lies in the way, and leaves its
share of the plank to the others. When it ends: when the plank touches the ground, when all
walkers fell, or at the horizon.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Mapping

import mujoco
import numpy as np
import pydantic
from jaxtyping import Bool, Float, Int

from hipg_bench.families import walker_body
from hipg_bench.families.family import EVERY, Harm, Rows
from hipg_bench.families.walker_body import Body, Pose
from hipg_bench.layout import SHARE, UNIT, Block, Layout, TaskLayout
from hipg_bench.sim import Sim
from hipg_bench.spec import Params as BaseParams
from hipg_bench.spec import TaskSpec, parse

_PHYSICS_STEP = 0.01
"""Seconds per physics step."""
_TOUCH = 0.002
"""A foot whose sole is lower than this touches the ground, m."""


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


@dataclasses.dataclass
class Snapshot:
    """The world at the end of a control step."""

    body: Body
    pose: Pose
    action: Float[np.ndarray, "B N A"]  # the last one
    health: Float[np.ndarray, "B N"]
    down: Float[np.ndarray, "B N"]  # control steps in a row tipped or sunk
    plank_low: Float[np.ndarray, "B"]  # height of the plank's lowest corner, m
    felt: tuple[dict[str, np.ndarray], dict[str, np.ndarray]] | None = None  # own bodies and the plank

    @functools.cached_property
    def touch(self) -> Bool[np.ndarray, "B N 2"]:
        """Feet on the ground."""
        # single precision tells a sole's height to a micrometre, and its sines are ten times faster
        joint = self.pose.joint.astype(np.float32)
        sole = walker_body.sole_height(self.body, self.pose.rotation[:, :-1], joint)
        return self.pose.position[:, :-1, 2, None] + sole < _TOUCH


class MultiWalker:
    """Rules of multi-walker; see `hipg_bench.families.family.Family` for each method."""

    causes: tuple[str, ...] = ("tipped", "sunk")
    metrics: tuple[str, ...] = ("displacement", "slip", "carriers", "tipped", "sunk", "dropped")

    def __init__(self, spec: TaskSpec) -> None:
        self.spec = spec
        self.params = params = parse(Params, spec.params, spec.task)
        n = spec.num_agents
        self.body = body = walker_body.body_of(params.planar)
        self.physics_steps = max(1, round(spec.control_step / _PHYSICS_STEP))
        self.fields: Mapping[str, int] = {"down": n, "displacement": 1, "slip": 1}
        self.chance_size = walker_body.chance_size(body, n)
        self._seats = walker_body.seats(n, params.spacing)
        self._servos = 2 * int(body.servo.sum())
        self._corners = walker_body.plank_corners(n, params.spacing, params.overhang)
        # in the plane, vectors have x and z only, and turning has y only
        self._axes, self._turns = (slice(0, 3, 2), slice(1, 2)) if params.planar else (slice(3), slice(3))
        self._dims, self._spins = (2, 1) if params.planar else (3, 3)
        # the plank's long axis points up by the pitch, aside by the yaw; its side axis points up by the roll
        self._lie = ([2], [0]) if params.planar else ([2, 2, 1], [0, 1, 0])
        self.layout = TaskLayout(self._observation(), self._action(), self._state())

    def scene(self) -> mujoco.MjSpec:
        """N walkers in a row under a plank."""
        params = self.params
        n = self.spec.num_agents
        scene = walker_body.walker_scene(self.body, n, params.spacing, params.overhang, params.plank_mass * n)
        scene.option.timestep = self.spec.control_step / self.physics_steps
        return scene

    def reset(self, sim: Sim, ids: Int[np.ndarray, "n"], chance: Float[np.ndarray, "n K"]) -> None:
        """Walkers stand nearly in the stance, the plank lies nearly in its place."""
        walker_body.place(self.body, sim, ids, chance, self._seats)

    def act(self, sim: Sim, was: Snapshot, action: Float[np.ndarray, "B N A"]) -> None:
        """Servo targets, around the stance."""
        sim.control[:] = action.reshape(len(action), -1)

    def read(self, sim: Sim, rows: Rows = EVERY) -> Snapshot:
        """Everything follows from the generalised coordinates, which do not lag behind the physics."""
        pose = walker_body.pose(self.body, sim, rows)
        x, y, z = (pose.rotation[:, -1, 2, k, None] * self._corners[:, k] for k in range(3))
        return Snapshot(
            body=self.body,
            pose=pose,
            action=sim.control[rows].reshape(len(pose.position), -1, self._servos).copy(),
            health=sim.field["health"][rows].copy(),
            down=sim.field["down"][rows].copy(),
            plank_low=pose.position[:, -1, 2] + (x + y + z).min(axis=1),
        )

    def renew(self, sim: Sim, now: Snapshot, ids: Int[np.ndarray, "n"], fresh: Snapshot) -> Snapshot:
        """Walkers fall at all times: in most steps a few worlds of many begin anew."""
        for whole, part in ((now, fresh), (now.pose, fresh.pose)):
            for name, array in vars(part).items():
                if isinstance(array, np.ndarray):
                    vars(whole)[name][ids] = array
        now.felt = None
        return now

    def harm(self, was: Snapshot, now: Snapshot) -> Harm:
        """Whoever is tipped or sunk for long enough has fallen."""
        tipped, _ = self._off_feet(now)
        fatal = self._down(was, now) >= self.params.fall_steps
        return Harm(np.zeros(fatal.shape), fatal, cause=np.where(tipped, 0, 1))

    def remember(self, sim: Sim, was: Snapshot, now: Snapshot) -> Snapshot:
        """Count the steps off one's feet, the plank's way, and how far it left its live carriers behind."""
        down = self._down(was, now)
        sim.field["down"][:] = down
        moved = now.pose.position[..., 0] - was.pose.position[..., 0]
        live = now.health > 0
        carried = np.where(live, moved[:, :-1], 0.0).sum(axis=1) / np.maximum(live.sum(axis=1), 1)
        sim.field["displacement"][:, 0] += moved[:, -1]
        sim.field["slip"][:, 0] += moved[:, -1] - carried
        now.down = down
        return now

    def reward(self, was: Snapshot, now: Snapshot) -> dict[str, Float[np.ndarray, "B"]]:
        """Terms of the step.

        ``progress``: the plank's way along x, m, at most the capped speed's; ``fall``: share of the team that
        fell in it; ``drop``: 1 where the plank is lost: on the ground, or with nobody left under it;
        ``effort``, ``jerk``: mean square of the actions and of their change; ``alive``: share of the team on
        its feet, which the tasks do not pay for but training may (standing still must earn nothing).
        """
        moved = now.pose.position[:, -1, 0] - was.pose.position[:, -1, 0]
        fell = (was.health > 0) & (now.health == 0)
        n = self.spec.num_agents
        return {
            "progress": np.minimum(moved, self.params.speed_cap * self.spec.control_step),
            "fall": fell.sum(axis=1) / n,
            "drop": (self._dropped(now) | self._fallen(now)).astype(np.float64),
            "effort": np.square(now.action).mean(axis=(1, 2)),
            "jerk": np.square(now.action - was.action).mean(axis=(1, 2)),
            "alive": (now.health > 0).sum(axis=1) / n,
        }

    def terminated(self, now: Snapshot) -> tuple[Bool[np.ndarray, "B"], str | np.ndarray]:
        """When the plank is on the ground, or nobody is left to carry it."""
        dropped, fallen = self._dropped(now), self._fallen(now)
        return dropped | fallen, np.where(dropped, "dropped", "all_fallen")

    def observe(self, now: Snapshot) -> Float[np.ndarray, "n N O"]:
        """Own body exactly, the plank above one's head, and the neighbours before and behind."""
        pose = now.pose
        own, plank = self._felt(now)
        head = pose.position[:, :-1] + self.body.head_top * pose.rotation[:, :-1, :, 2]
        # into the plank's frame
        seat = np.einsum("...ni,...ij->...nj", head - pose.position[:, -1:], pose.rotation[:, -1])
        seat[..., 0] -= self._seats
        parts = {
            "health": now.health[..., None],
            "height": pose.position[:, :-1, 2:],
            **own,
            "head_on_plank": seat[..., self._axes],
            **{name: part[:, None] for name, part in plank.items()},
            **self._neighbors(now),
        }
        return self.layout.observation.pack(parts, now.health.shape)

    def state(self, now: Snapshot) -> Float[np.ndarray, "n S"]:
        """All bodies, and how long each walker has been off its feet."""
        pose = now.pose
        own, plank = self._felt(now)
        place = pose.position[:, :-1] - pose.position[:, -1:]
        place[..., 0] -= self._seats
        parts = {
            "health": now.health,
            "down": now.down,
            "place": place[..., self._axes],
            **own,
            "plank_position": pose.position[:, -1, self._axes],
            **plank,
        }
        return self.layout.state.pack(parts, now.health.shape[:1])

    def measure(
        self, sim: Sim, ids: Int[np.ndarray, "n"], now: Snapshot
    ) -> dict[str, Float[np.ndarray, "n"]]:
        """Way of the plank and of it the slip over its live carriers, m; live carriers; falls by cause."""
        field = sim.field
        dead = field["health"][ids] == 0
        cause = field["death_cause"][ids]
        return {
            "displacement": field["displacement"][ids, 0],
            "slip": field["slip"][ids, 0],
            "carriers": (~dead).sum(axis=1),
            "tipped": (dead & (cause == 0)).sum(axis=1),
            "sunk": (dead & (cause == 1)).sum(axis=1),
            "dropped": self._dropped(now)[ids],
        }

    def _off_feet(self, now: Snapshot) -> tuple[Bool[np.ndarray, "B N"], Bool[np.ndarray, "B N"]]:
        """Who is tipped, and who is sunk."""
        tipped = now.pose.rotation[:, :-1, 2, 2] < self.params.upright
        return tipped, now.pose.position[:, :-1, 2] < self.params.sunk * self.body.height

    def _down(self, was: Snapshot, now: Snapshot) -> Float[np.ndarray, "B N"]:
        """Control steps in a row off one's feet, up to those that make a fall."""
        tipped, sunk = self._off_feet(now)
        return np.where(tipped | sunk, np.minimum(was.down + 1, self.params.fall_steps), 0.0)

    def _dropped(self, now: Snapshot) -> Bool[np.ndarray, "B"]:
        return now.plank_low < self.params.drop_height

    def _fallen(self, now: Snapshot) -> Bool[np.ndarray, "B"]:
        return (now.health == 0).all(axis=1)

    def _felt(self, now: Snapshot) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
        """Own bodies and the plank, as observations and joint states have them alike."""
        if now.felt is None:
            now.felt = self._proprioception(now), self._plank(now)
        return now.felt

    def _proprioception(self, now: Snapshot) -> dict[str, np.ndarray]:
        """What each walker feels of its own body; the blocks of `_proprioception_blocks`."""
        pose = now.pose
        rotation = pose.rotation[:, :-1]
        # v R is R^T v: from the world into the body's frame
        velocity = np.einsum("...i,...ij->...j", pose.velocity[:, :-1], rotation)
        parts = {
            "up": rotation[..., 2, self._axes],
            "heading": rotation[..., 0, :],
            "velocity": velocity[..., self._axes],
            "spin": pose.spin[:, :-1, self._turns],
            "joint": pose.joint,
            "joint_rate": pose.joint_rate,
            "touch": now.touch,
            "action": now.action,
        }
        if self.params.planar:
            del parts["heading"]
        return parts

    def _plank(self, now: Snapshot) -> dict[str, np.ndarray]:
        """How the plank lies and moves; the blocks of `_plank_blocks`."""
        rotation, velocity = now.pose.rotation[:, -1], now.pose.velocity[:, -1]
        return {
            "plank_lie": rotation[:, *self._lie],
            "plank_velocity": velocity[:, self._axes],
            "plank_spin": now.pose.spin[:, -1, self._turns],
        }

    def _neighbors(self, now: Snapshot) -> dict[str, np.ndarray]:
        """The walkers behind and before each one: gap beyond the seats' spacing, and relative velocity."""
        there = np.ones((*now.health.shape, 2))
        there[:, 0, 0] = there[:, -1, 1] = 0
        health = np.zeros_like(there)
        health[:, 1:, 0], health[:, :-1, 1] = now.health[:, :-1], now.health[:, 1:]
        gap, speed = np.zeros((2, *there.shape, 3))
        way, lead = (of[:, 1:-1] - of[:, :-2] for of in (now.pose.position, now.pose.velocity))
        way[..., 0] -= self.params.spacing
        gap[:, 1:, 0], gap[:, :-1, 1] = -way, way
        speed[:, 1:, 0], speed[:, :-1, 1] = -lead, lead
        return {
            "neighbor_there": there,
            "neighbor_health": health,
            "neighbor_gap": gap[..., self._axes],
            "neighbor_velocity": speed[..., self._axes],
        }

    def _observation(self) -> Layout:
        d, there = self._dims, "where there is one, dead or alive"
        return Layout((
            Block("health", (1,), "1", limits=SHARE),
            Block("height", (1,), "m", "world"),
            *self._proprioception_blocks(()),
            Block("head_on_plank", (d,), "m", "plank, from one's seat"),
            *self._plank_blocks(),
            Block("neighbor_there", (2,), "1", "-", "behind, ahead", limits=SHARE),
            Block("neighbor_health", (2,), "1", "-", there, limits=SHARE),
            Block("neighbor_gap", (2, d), "m", "own place, less the seats' spacing", there),
            Block("neighbor_velocity", (2, d), "m/s", "world, relative", there),
        ))  # fmt: skip

    def _action(self) -> Layout:
        servos = self._servos // 2
        what = "hip, knee" if self.params.planar else "hip abduction, hip, knee"
        return Layout(
            (Block("servo_target", (2, servos), f"of the range of left and right {what}", "from the stance"),)
        )

    def _state(self) -> Layout:
        n, d = self.spec.num_agents, self._dims
        return Layout((
            Block("health", (n,), "1", limits=SHARE),
            Block("down", (n,), "control steps off one's feet"),
            Block("place", (n, d), "m", "world, from the plank's middle and one's seat"),
            *self._proprioception_blocks((n,)),
            Block("plank_position", (d,), "m", "world"),
            *self._plank_blocks(),
        ))  # fmt: skip

    def _proprioception_blocks(self, lead: tuple[int, ...]) -> tuple[Block, ...]:
        d, turns, joints = self._dims, self._spins, self.body.joints
        heading = (
            ()
            if self.params.planar
            else (Block("heading", (*lead, 3), "1", "world's x axis in the body's", limits=UNIT),)
        )
        return (
            Block("up", (*lead, d), "1", "world's z axis in the body's", limits=UNIT),
            *heading,
            Block("velocity", (*lead, d), "m/s", "body"),
            Block("spin", (*lead, turns), "rad/s", "body"),
            Block("joint", (*lead, 2, joints), "rad"),
            Block("joint_rate", (*lead, 2, joints), "rad/s"),
            Block("touch", (*lead, 2), "1"),
            Block("action", (*lead, self._servos), "1", limits=UNIT),
        )

    def _plank_blocks(self) -> tuple[Block, ...]:
        d, turns = self._dims, self._spins
        return (
            Block("plank_lie", (turns,), "1", "sines of pitch, roll and yaw"),
            Block("plank_velocity", (d,), "m/s", "world"),
            Block("plank_spin", (turns,), "rad/s", "plank"),
        )
