"""How drones are shown: watch lines to points, radio links between terminals, hazards, trails."""

from __future__ import annotations

import itertools

import mujoco
import numpy as np
from jaxtyping import Bool, Float

from hipg_bench.mechanics.radio import count_hops
from hipg_bench.rendering import palette
from hipg_bench.rendering.agents import AgentVisuals
from hipg_bench.rendering.camera import FIELD_OF_VIEW, Camera
from hipg_bench.rendering.look import WHITE, Status
from hipg_bench.rendering.motion import Trajectory
from hipg_bench.rendering.painter import Painter

_TRAIL = 1.2
"""Seconds of the past that trails show."""
_WATCHED = 0.6
"""Lines from points fade over this distance, m."""
_BRIGHTNESS = 1.6
"""Of the light that falls on points and lamps and comes from them; their hues are divided by it."""
_STEEL = (0.55, 0.62, 0.72)
_X, _Y, _Z = np.eye(3)


class Drones:
    """The box or plane that drones move in, and their traces."""

    body_size = 0.055
    travels = False

    def __init__(self, trajectory: Trajectory, visuals: AgentVisuals) -> None:
        self.trajectory = trajectory
        self.visuals = visuals
        self._half = float(trajectory.spec.params["half_width"])
        # the paper's particles live in a plane
        self._ceiling = float(trajectory.spec.params.get("ceiling", 0.0))
        self.reach = 3.2 * self._half

    @property
    def places(self) -> Float[np.ndarray, "N 3"]:
        """Where the drones are, m."""
        return self.trajectory.data.xpos[self.visuals.root]

    def label_place(self, agent: int) -> np.ndarray:
        """Above the drone."""
        return self.visuals.place(agent) + 0.085 * _Z

    def camera(self, time: float) -> Camera:
        """The whole box from a place that drifts a little; a plane from steeply above."""
        share = time / (self.trajectory.spec.horizon * self.trajectory.spec.control_step)
        if not self._ceiling:
            return Camera(
                np.array([0.0, -0.05 * self._half, 0.0]), 3.8 * self._half, 86.0 + 8.0 * share, -58.0
            )
        reach = np.hypot(np.sqrt(2) * self._half, self._ceiling / 2)
        distance = 0.79 * float(reach) / np.tan(np.radians(FIELD_OF_VIEW) / 2)
        azimuth = 78.0 + 26.0 * share
        # a little to the left of the middle, since panels cover the left of the picture
        left = 0.10 * self._half * np.array([-np.sin(np.radians(azimuth)), np.cos(np.radians(azimuth)), 0.0])
        return Camera(left + 0.37 * self._ceiling * _Z, distance, azimuth, -24.5)

    def draw_arena(self, painter: Painter, time: float) -> None:
        """The floor within the walls, the box that drones cannot leave, trails and plumb lines."""
        half = self._half
        painter.box((0.0, 0.0, 0.0005), (half, half, 0.0004), (0.16, 0.20, 0.27), 0.55)
        painter.edges(
            (-half, -half, 0.001), (half, half, max(0.001, self._ceiling)), 0.0022, (0.5, 0.6, 0.75), 0.3
        )
        for agent, place in enumerate(self.places):
            died, colour = float(self.trajectory.lifetime[agent]), self.visuals.colour[agent]
            if time - died < _TRAIL:
                start, end = max(time - _TRAIL, 0.0), min(time, died)
                painter.trail(
                    self.trajectory.path(int(self.visuals.root[agent]), start, end, 16), 0.007, colour, 0.7
                )
            if time < died and not self._ceiling:
                # some particles are as small as 1 cm
                painter.ball(place, 0.03, colour, 0.5)
            if time < died and self._ceiling:
                painter.line(place, (place[0], place[1], 0.003), 0.0012, colour, 0.22)
                painter.disc((place[0], place[1], 0.002), 0.022, colour, 0.35)

    def draw_hazard(self, painter: Painter, centre: np.ndarray, revealed_for: float, time: float) -> None:
        """A ball of the true radius: dashed while nobody knows of it, dense once known."""
        radius, red = float(self.trajectory.spec.params["hazard_radius"]), palette.DANGER
        top = centre + radius * _Z
        if revealed_for < 0:
            painter.ball(centre, radius, red, 0.09, glow=0.7)
            for axes in ((_X, _Y), (_X, _Z), (_Y, _Z)):
                painter.ring(
                    centre, radius, 0.0028, red, 0.6, axes=axes, pieces=40, dashed=True, turn=0.15 * time
                )
            painter.write(top, "hidden hazard", palette.blend(red, WHITE, 0.45))
            return
        beat = 0.5 + 0.5 * np.cos(2 * np.pi * 0.9 * revealed_for)
        for share, alpha in ((1.0, 0.13 + 0.06 * beat), (0.68, 0.14), (0.36, 0.20)):
            painter.ball(centre, radius * share, red, alpha, glow=0.8)
        painter.ring(centre, radius, 0.0045, red, 0.95, pieces=40)
        if revealed_for < 0.8:
            share = revealed_for / 0.8
            painter.ring(centre, radius * (0.3 + 1.5 * share), 0.006, red, 0.9 * (1 - share), pieces=40)
        painter.write(top, "HAZARD", palette.blend(red, WHITE, 0.25), strong=True)

    def tint(self, prefix: str, colour: np.ndarray, *, but: tuple[str, ...] = ()) -> None:
        """Colour the geoms whose names begin with a prefix, opacity kept."""
        model = self.trajectory.model
        for k in range(model.ngeom):
            name = mujoco.mj_id2name(model, int(mujoco.mjtObj.mjOBJ_GEOM), k) or ""
            if name.startswith(prefix) and name.removeprefix(prefix) not in but:
                model.geom_rgba[k, :3] = colour / _BRIGHTNESS


class Navigation(Drones):
    """Points on stems, each linked to the live drone nearest to it, and the hazards among them."""

    legend = "a point takes the colour of whoever watches it  ·  red kills"

    def update(self, time: float) -> None:
        """Colour the points."""
        for k, (_, colour, share) in enumerate(self._watchers(time)):
            self.tint(f"point{k}/", palette.blend(colour, WHITE, 0.25 * share))

    def decorate(self, painter: Painter, time: float) -> list[Status]:
        """Draw arena, points and hazards."""
        self.draw_arena(painter, time)
        now = self.trajectory.remembered(time)
        known_for = self.trajectory.since("revealed", time)
        points, places = self.trajectory.data.mocap_pos, self.places
        for k, (nearest, colour, share) in enumerate(self._watchers(time)):
            point = points[k]
            if nearest >= 0:
                width, alpha = 0.0022 + 0.0025 * share, 0.10 + 0.75 * share
                painter.line(point, places[nearest], width, self.visuals.colour[nearest], alpha)
            if point[2] > 0.05:
                painter.line((point[0], point[1], 0.003), point - 0.045 * _Z, 0.0022, _STEEL, 0.55, glow=0.2)
                painter.disc((point[0], point[1], 0.003), 0.03, _STEEL, 0.5)
            if share > 0:
                painter.ball(point, 0.055 + 0.02 * share, colour, 0.22 * share, glow=1.0)
            if now["hazardous"][k]:
                self.draw_hazard(painter, point, float(known_for[k]), time)
        return _hazard_status(int((now["hazardous"] > 0).sum()), int((now["revealed"] > 0).sum()))

    def _watchers(self, time: float) -> list[tuple[int, np.ndarray, float]]:
        """Per point: nearest live agent (-1: none), the point's colour, how closely it is watched, 0..1."""
        alive = self.trajectory.remembered(time)["health"] > 0
        idle = np.asarray(palette.IDLE)
        points = self.trajectory.data.mocap_pos
        if not alive.any():
            return [(-1, idle, 0.0)] * len(points)
        gap = np.linalg.norm(points[:, None] - self.places[None], axis=-1)
        gap = np.where(alive, gap, np.inf)
        nearest = gap.argmin(axis=1)
        share = np.clip(1.15 - gap.min(axis=1) / _WATCHED, 0.0, 1.0)
        return [
            (agent, palette.blend(idle, self.visuals.colour[agent], part), part)
            for agent, part in zip(nearest.tolist(), share.tolist(), strict=True)
        ]


class Communication(Drones):
    """Radio masts, links between live nodes, a shortest chain between the terminals, the hazard."""

    legend = "green: the chain that links the terminals  ·  red kills"

    def __init__(self, trajectory: Trajectory, visuals: AgentVisuals) -> None:
        super().__init__(trajectory, visuals)
        # in the paper's tasks the range follows from the team's size
        definition = trajectory.definition
        self._range = float(definition.family.numbers(trajectory.spec, definition.params)["link_range"])

    def update(self, time: float) -> None:
        """Light the terminals' lamps."""
        linked = bool(_reached(self._links(time))[1])
        for k in (0, 1):
            self.tint(f"terminal{k}/", np.asarray(palette.LINK if linked else WHITE), but=("collar", "spike"))

    def decorate(self, painter: Painter, time: float) -> list[Status]:
        """Draw arena, network and hazard."""
        self.draw_arena(painter, time)
        node, links = self._nodes, self._links(time)
        reached = _reached(links)
        linked = bool(reached[1])
        chain = _chain(links) if linked else []
        in_chain = {frozenset(pair) for pair in itertools.pairwise(chain)}
        for a, b in np.argwhere(np.triu(links)).tolist():
            if frozenset((a, b)) in in_chain:
                painter.line(node[a], node[b], 0.0065, palette.LINK, 1.0, glow=1.0)
                painter.line(node[a], node[b], 0.016, palette.LINK, 0.22, glow=1.0)
            elif linked and reached[a]:
                painter.line(node[a], node[b], 0.0035, palette.LINK, 0.40)
            else:
                painter.line(node[a], node[b], 0.0035, palette.IDLE, 0.45)
        _draw_messages(painter, node[chain], time)
        for k in (0, 1):
            _draw_mast(painter, node[k], palette.LINK if linked else WHITE)
            painter.write(node[k] + 0.19 * _Z, "AB"[k], WHITE, strong=True)
        self.draw_hazard(painter, self.trajectory.data.mocap_pos[2], -1.0, time)
        link = Status("terminals linked", palette.LINK) if linked else Status("no link", palette.IDLE)
        return [link, *_hazard_status(1, 0)]

    @property
    def _nodes(self) -> Float[np.ndarray, "M 3"]:
        """The terminals, then the drones, m."""
        return np.concatenate([self.trajectory.data.mocap_pos[:2], self.places])

    def _links(self, time: float) -> Bool[np.ndarray, "M M"]:
        """Who hears whom; the terminals never hear each other."""
        node = self._nodes
        up = np.concatenate([[True, True], self.trajectory.remembered(time)["health"] > 0])
        apart = np.linalg.norm(node[:, None] - node[None], axis=-1)
        links = (apart <= self._range) & up[:, None] & up[None] & ~np.eye(len(node), dtype=bool)
        links[0, 1] = links[1, 0] = False
        return links


def _hazard_status(hazards: int, known: int) -> list[Status]:
    if not hazards:
        return []
    if known:
        return [
            Status(
                "hazard revealed" if hazards == 1 else f"{known} of {hazards} hazards revealed",
                palette.DANGER,
            )
        ]
    return [Status("hazard hidden" if hazards == 1 else f"{hazards} hazards hidden", (0.85, 0.5, 0.45))]


def _draw_mast(painter: Painter, place: np.ndarray, colour: tuple[float, ...]) -> None:
    """A halo around a terminal's lamp, and the tripod it stands on."""
    painter.ball(place, 0.06, colour, 0.25, glow=1.0)
    if place[2] < 0.05:
        return
    foot = np.array([place[0], place[1], 0.0])
    painter.line(foot, place - 0.05 * _Z, 0.009, _STEEL, glow=0.1)
    for angle in (0.0, 2.094, 4.189):
        spread = 0.10 * (np.cos(angle) * _X + np.sin(angle) * _Y)
        painter.line(foot + spread, foot + 0.45 * (place - foot), 0.004, _STEEL, glow=0.1)


def _reached(links: Bool[np.ndarray, "M M"]) -> Bool[np.ndarray, "M"]:
    """Nodes to which there is a way from node 0."""
    hops, queue = np.empty((2, len(links)), np.int64)
    count_hops(links, 0, hops, queue)
    return hops >= 0


def _chain(links: Bool[np.ndarray, "M M"]) -> list[int]:
    """Nodes of a shortest chain from node 0 to node 1, which must be connected."""
    before = {0: 0}
    queue = [0]
    for node in queue:
        for further in np.flatnonzero(links[node]).tolist():
            if further not in before:
                before[further] = node
                queue.append(further)
    chain = [1]
    while chain[-1] != 0:
        chain.append(before[chain[-1]])
    return chain[::-1]


def _draw_messages(painter: Painter, chain: Float[np.ndarray, "n 3"], time: float) -> None:
    """Sparks that run along the chain."""
    if len(chain) < 2:
        return
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(chain, axis=0), axis=1))])
    for k in range(3):
        at = ((0.35 * time + k / 3) % 1.0) * length[-1]
        place = np.array([np.interp(at, length, chain[:, axis]) for axis in range(3)])
        painter.ball(place, 0.016, (0.85, 1.0, 0.92), 1.0, glow=1.0)
        painter.ball(place, 0.030, palette.LINK, 0.35, glow=1.0)
