"""Colours. Red means danger and nothing else; every agent has a hue of its own that is not red."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

DANGER = (1.0, 0.20, 0.13)
"""Hazards, and what they did."""
WRECK = (0.16, 0.16, 0.17)
"""Bodies of the dead."""
LINK = (0.25, 1.0, 0.62)
"""Radio links that carry messages."""
IDLE = (0.52, 0.60, 0.72)
"""What does nothing at the moment: idle links, points that nobody watches."""

_FIRST_HUE, _LAST_HUE = 80.0, 345.0
"""Amber to pink through green, blue and violet, degrees in OKLCH; the arc left out is red."""
_LIGHTNESS, _CHROMA = 0.80, 0.14


def team(num_agents: int) -> Float[np.ndarray, "N 3"]:
    """One colour per agent, equally light, sRGB in [0, 1]."""
    hue = np.radians(np.linspace(_FIRST_HUE, _LAST_HUE, num_agents))
    return _srgb(np.full_like(hue, _LIGHTNESS), _CHROMA * np.cos(hue), _CHROMA * np.sin(hue))


def blend(a: tuple[float, ...] | np.ndarray, b: tuple[float, ...] | np.ndarray, share: float) -> np.ndarray:
    """Colour between ``a`` (share 0) and ``b`` (share 1)."""
    return (1.0 - share) * np.asarray(a) + share * np.asarray(b)


def _srgb(lightness: np.ndarray, a: np.ndarray, b: np.ndarray) -> Float[np.ndarray, "N 3"]:
    """OKLab to sRGB, out-of-gamut values clipped (Ottosson, https://bottosson.github.io/posts/oklab)."""
    cone = np.stack([
        lightness + 0.3963377774 * a + 0.2158037573 * b,
        lightness - 0.1055613458 * a - 0.0638541728 * b,
        lightness - 0.0894841775 * a - 1.2914855480 * b,
    ])  # fmt: skip
    mix = np.array([
        [4.0767416621, -3.3077115913, 0.2309699292],
        [-1.2684380046, 2.6097574011, -0.3413193965],
        [-0.0041960863, -0.7034186147, 1.7076147010],
    ])  # fmt: skip
    linear = np.clip(mix @ cone**3, 0.0, 1.0)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055).T
