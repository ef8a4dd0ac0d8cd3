"""What is written on a picture: who, how healthy, when, how much, and how it ended."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence
from pathlib import Path

import matplotlib
import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image, ImageDraw, ImageFont

from hipg_bench.rendering import palette
from hipg_bench.rendering.camera import Camera
from hipg_bench.rendering.look import WHITE, Status
from hipg_bench.rendering.painter import Label

_REFERENCE_HEIGHT = 720
"""Sizes below are pixels of a picture of this height; all scale with it."""
_PANEL = (10, 14, 22, 165)
_BAR_BACK = (255, 255, 255, 38)
_DIM = (0.62, 0.68, 0.78)


@dataclasses.dataclass(frozen=True)
class Caption:
    """What stays the same through a film.

    Attributes:
        task: its name.
        agent: who plays.
        legend: what the colours mean.
        pace: seconds of the world per second of film.
        duration: of the longest episode, s.
        colour: (N, 3) of the agents.
    """

    task: str
    agent: str
    legend: str
    pace: float
    duration: float
    colour: Float[np.ndarray, "N 3"]


@dataclasses.dataclass(frozen=True)
class Reading:
    """What changes from frame to frame.

    Attributes:
        time: s.
        team_return: so far.
        health: (N,) in [0, 1].
        status: what the family has to say.
    """

    time: float
    team_return: float
    health: Float[np.ndarray, "N"]
    status: Sequence[Status]


class Hud:
    """Writes on frames of one size."""

    def __init__(self, caption: Caption, width: int, height: int) -> None:
        self._caption = caption
        self._size = (width, height)
        self._unit = height / _REFERENCE_HEIGHT
        self._rows = _row_height(len(caption.colour))
        self._still = self._unchanging()

    @property
    def blank(self) -> Image.Image:
        """A black picture."""
        return Image.new("RGB", self._size)

    def write(
        self,
        frame: UInt8[np.ndarray, "height width 3"],
        camera: Camera,
        labels: Sequence[Label],
        reading: Reading,
    ) -> Image.Image:
        """Put labels, panels and numbers on a frame."""
        picture = Image.fromarray(frame)
        self._label(picture, camera, labels)
        picture.paste(self._still, (0, 0), self._still)
        self._bars(picture, reading.health)
        draw = ImageDraw.Draw(picture, "RGBA")  # in this mode it blends
        width, height = self._size
        right = width - self._px(30)
        draw.text(
            (right, self._px(30)),
            f"{reading.time:4.1f} s",
            _ink(WHITE),
            self._font(21, bold=True),
            anchor="ra",
        )
        draw.text(
            (right, self._px(60)),
            f"{reading.team_return:.1f}",
            _ink(WHITE),
            self._font(21, bold=True),
            anchor="ra",
        )
        x = width - self._px(18)
        for status in reversed(reading.status):
            x = self._chip(picture, x, height - self._px(18), status) - self._px(10)
        done = min(1.0, reading.time / self._caption.duration)
        draw.rectangle((0, height - self._px(4), round(width * done), height), _ink(WHITE, 0.75))
        return picture

    def end_card(
        self, picture: Image.Image, share: float, headline: str, lines: Sequence[str]
    ) -> Image.Image:
        """The last frame, veiled, with what came of the episode; ``share`` in [0, 1] fades it in."""
        width, height = self._size
        veil = Image.new("RGBA", self._size, (6, 9, 15, round(95 * share)))
        draw = ImageDraw.Draw(veil)
        tall = self._px(96 + 30 * len(lines))
        wide = self._px(460)
        left, top = (width - wide) // 2, (height - tall) // 2
        radius = self._px(14)
        draw.rounded_rectangle((left, top, left + wide, top + tall), radius, (12, 16, 26, round(238 * share)))
        middle = width // 2
        draw.text(
            (middle, top + self._px(48)), headline, _ink(WHITE, share), self._font(27, bold=True), anchor="mm"
        )
        for k, line in enumerate(lines):
            y = top + self._px(92 + 30 * k)
            draw.text((middle, y), line, _ink(_DIM, share), self._font(17), anchor="mm")
        return Image.alpha_composite(picture.convert("RGBA"), veil).convert("RGB")

    def _unchanging(self) -> Image.Image:
        """Panels, names and the legend, drawn once; twice as large and shrunk, for smooth corners."""
        width, height = self._size
        large = Image.new("RGBA", (2 * width, 2 * height), (0, 0, 0, 0))
        draw = ImageDraw.Draw(large)
        caption, unit = self._caption, 2 * self._unit
        panels = [
            (18, 18, 288, 88),
            (18, 98, 288, 112 + self._rows * len(caption.colour)),
            (width / self._unit - 208, 18, width / self._unit - 18, 96),
        ]
        for panel in panels:
            draw.rounded_rectangle(tuple(round(unit * edge) for edge in panel), round(unit * 10), _PANEL)
        still = large.resize(self._size, Image.Resampling.BOX)
        draw = ImageDraw.Draw(still)
        draw.text((self._px(32), self._px(29)), caption.task, _ink(WHITE), self._font(21, bold=True))
        draw.text((self._px(32), self._px(58)), caption.agent, _ink(_DIM), self._font(15))
        left = width - self._px(194)
        pace = "time" if caption.pace == 1 else f"time  \N{MULTIPLICATION SIGN}{caption.pace:g}"
        draw.text((left, self._px(36)), pace, _ink(_DIM), self._font(14))
        draw.text((left, self._px(66)), "return", _ink(_DIM), self._font(14))
        draw.text(
            (self._px(20), height - self._px(20)), caption.legend, _ink(_DIM), self._font(14), anchor="ls"
        )
        return still

    def _bars(self, picture: Image.Image, health: Float[np.ndarray, "N"]) -> None:
        """One health bar per agent; the dead are crossed out."""
        draw = ImageDraw.Draw(picture, "RGBA")
        font, bold = self._font(min(14, self._rows - 5)), self._font(min(13, self._rows - 5), bold=True)
        left, right = self._px(62), self._px(274)
        thick = max(2, self._px(min(10, self._rows * 0.45)))
        for agent, value in enumerate(health.tolist()):
            middle = self._px(105 + self._rows * (agent + 0.5))
            top, bottom = middle - thick // 2, middle - thick // 2 + thick
            colour = self._caption.colour[agent] if value > 0 else np.array([0.5, 0.5, 0.5])
            draw.text((self._px(48), middle), str(agent + 1), _ink(colour), bold, anchor="rm")
            if value > 0:
                draw.rounded_rectangle((left, top, right, bottom), thick // 2, _BAR_BACK)
                end = left + max(thick, round((right - left) * value))
                draw.rounded_rectangle((left, top, end, bottom), thick // 2, _ink(colour))
            else:
                draw.rounded_rectangle(
                    (left, top, right - self._px(52), bottom), thick // 2, _ink(palette.DANGER, 0.28)
                )
                draw.text((right, middle), "DEAD", _ink(palette.DANGER), font, anchor="rm")

    def _label(self, picture: Image.Image, camera: Camera, labels: Sequence[Label]) -> None:
        """Words at places of the world; nearer ones over farther ones."""
        if not labels:
            return
        width, height = self._size
        pixel, depth = camera.project(np.stack([label.place for label in labels]), width, height)
        draw = ImageDraw.Draw(picture, "RGBA")
        for k in np.argsort(-depth).tolist():
            x, y = pixel[k]
            if depth[k] <= 0.05 or not (0 <= x < width and 0 <= y < height):
                continue
            label = labels[k]
            font = self._font(15 if label.strong else 13, bold=label.strong)
            draw.text(
                (x, y),
                label.text,
                _ink(label.colour),
                font,
                anchor="ms",
                stroke_width=self._px(1.5),
                stroke_fill=(8, 11, 18, 150),
            )

    def _chip(self, picture: Image.Image, right: int, bottom: int, status: Status) -> int:
        """A word in a pill whose lower right corner is given; returns its left edge."""
        font = self._font(15, bold=True)
        wide = round(font.getlength(status.text)) + self._px(42)
        tall = self._px(32)
        chip = Image.new("RGBA", (2 * wide, 2 * tall), (0, 0, 0, 0))
        ImageDraw.Draw(chip).rounded_rectangle((0, 0, 2 * wide - 1, 2 * tall - 1), tall, _PANEL)
        dot = self._px(5)
        spot = (2 * self._px(18), tall)
        ImageDraw.Draw(chip).ellipse(
            (spot[0] - 2 * dot, spot[1] - 2 * dot, spot[0] + 2 * dot, spot[1] + 2 * dot), _ink(status.colour)
        )
        chip = chip.resize((wide, tall), Image.Resampling.BOX)
        ImageDraw.Draw(chip).text((self._px(30), tall // 2), status.text, _ink(WHITE), font, anchor="lm")
        picture.paste(chip, (max(0, right - wide), bottom - tall), chip)
        return right - wide

    def _px(self, size: float) -> int:
        return round(size * self._unit)

    def _font(self, size: float, *, bold: bool = False) -> ImageFont.FreeTypeFont:
        return _font(max(6, self._px(size)), bold=bold)


@functools.cache
def _font(pixels: int, *, bold: bool) -> ImageFont.FreeTypeFont:
    """DejaVu Sans, which comes with matplotlib."""
    name = "DejaVuSans-Bold.ttf" if bold else "DejaVuSans.ttf"
    return ImageFont.truetype(str(Path(matplotlib.get_data_path()) / "fonts" / "ttf" / name), pixels)


def _row_height(num_agents: int) -> float:
    """Of a health bar, so that any team fits above the legend."""
    return min(24.0, 540.0 / num_agents)


def _ink(colour: Sequence[float] | np.ndarray, alpha: float = 1.0) -> tuple[int, int, int, int]:
    red, green, blue = (round(255 * min(1.0, max(0.0, float(part)))) for part in colour)
    return red, green, blue, round(255 * alpha)
