"""What every family's look has in common: what it must say, and how the dead are shown."""

from __future__ import annotations

import dataclasses
from typing import Protocol, runtime_checkable

import numpy as np

from hipg_bench.rendering import palette
from hipg_bench.rendering.agents import AgentVisuals
from hipg_bench.rendering.camera import Camera
from hipg_bench.rendering.motion import Trajectory
from hipg_bench.rendering.painter import Painter

WHITE = (0.93, 0.95, 1.0)
"""Of neutral words and marks."""


@dataclasses.dataclass(frozen=True)
class Status:
    """Something to say beside the picture.

    Attributes:
        text: a few words.
        colour: red, green, blue in [0, 1].
    """

    text: str
    colour: tuple[float, ...]


@runtime_checkable
class Look(Protocol):
    """How a family is shown, for one world.

    Attributes:
        legend: what the colours mean, one line.
        body_size: rough radius of an agent, m.
        reach: half the width of what casts shadows, m.
        travels: whether the team leaves the place where it began.
    """

    legend: str
    travels: bool
    body_size: float
    reach: float

    def __init__(self, trajectory: Trajectory, visuals: AgentVisuals) -> None: ...

    def update(self, time: float) -> None:
        """Colour what is in the model, as of the time that the trajectory shows."""
        ...

    def label_place(self, agent: int) -> np.ndarray:
        """Where an agent's number is written, m."""
        ...

    def decorate(self, painter: Painter, time: float) -> list[Status]:
        """Draw what matters at the time that the trajectory shows; return what to say about it."""
        ...

    def camera(self, time: float) -> Camera:
        """Where to look from."""
        ...


def mark_agents(
    painter: Painter, look: Look, visuals: AgentVisuals, trajectory: Trajectory, time: float
) -> None:
    """Number everyone; a flash, smoke and a scorched spot for the dead."""
    for agent in range(trajectory.num_agents):
        place = visuals.place(agent)
        beside = look.label_place(agent)
        dead_for = time - float(trajectory.lifetime[agent])
        if dead_for < 0:
            painter.write(beside, str(agent + 1), palette.blend(visuals.colour[agent], WHITE, 0.35))
            continue
        text = f"{agent + 1} \N{MULTIPLICATION X}"
        painter.write(beside, text, palette.blend(palette.DANGER, WHITE, 0.3), strong=True)
        _death(painter, agent, place, look.body_size, dead_for, time)


def _death(
    painter: Painter, agent: int, place: np.ndarray, size: float, dead_for: float, time: float
) -> None:
    flash = dead_for / 0.45
    if flash < 1:
        alpha = 0.55 * (1 - flash) ** 1.5
        painter.ball(place, size * (0.6 + 2.0 * flash), (1.0, 0.55, 0.25), alpha, glow=1.0)
    if place[2] < 5 * size:
        spot = (place[0], place[1], 0.002)
        painter.disc(spot, 1.7 * size, (0.01, 0.01, 0.01), 0.55 * min(1.0, dead_for), glow=0.0)
    # puffs rise, widen and thin, and stop after some seconds
    strength = float(np.clip(dead_for / 0.3, 0, 1) * np.clip((4.0 - dead_for) / 2.0, 0, 1))
    for k in range(5 if strength > 0 else 0):
        age = (0.55 * time + k / 5 + 0.37 * agent) % 1.0
        sway = 0.5 * size * np.array([np.sin(2.1 * k + 5 * age), np.cos(1.7 * k + 4 * age), 0.0])
        centre = place + age * (sway + np.array([0.0, 0.0, 5.0 * size]))
        alpha = 0.30 * strength * (1 - age)
        painter.ball(centre, size * (0.25 + 0.6 * age), (0.32, 0.32, 0.34), alpha, glow=0.2)
