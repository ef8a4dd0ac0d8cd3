"""How harm becomes death.

Each agent draws a toughness E ~ Exp(1) at reset. A step that kills with probability p adds
-log(1 - p) to its exposure; it dies when exposure reaches toughness. The chance of outliving
steps p1, p2, ... is then exp(-sum(-log(1 - pk))) = prod(1 - pk): exactly the law of one
independent coin per step, while the step itself is deterministic.
"""

from __future__ import annotations

import numpy as np
from array_api_compat import array_namespace
from jaxtyping import Bool, Float


def hazard_rate(probability: Float[np.ndarray, "..."], steps: float) -> Float[np.ndarray, "..."]:
    """Exposure gained in a control step, from the death probability per reference step.

    Args:
        probability: chance of death per reference step of 0.1 s, in [0, 1).
        steps: control step in reference steps, so that the law does not depend on the control rate.

    Returns:
        Exposure in nats, >= 0, of the same shape.
    """
    xp = array_namespace(probability)
    return -steps * xp.log1p(-probability)


def damage(
    health: Float[np.ndarray, "*agents"],
    exposure: Float[np.ndarray, "*agents"],
    toughness: Float[np.ndarray, "*agents"],
    gained: Float[np.ndarray, "*agents"],
    fatal: Bool[np.ndarray, "*agents"],
    *,
    graded: bool,
) -> tuple[Float[np.ndarray, "*agents"], Float[np.ndarray, "*agents"]]:
    """Apply one step's harm. Health never rises, and the dead gain no exposure.

    Args:
        health: before the step, in [0, 1].
        exposure: gathered so far, nats.
        toughness: exposure that kills, nats, > 0.
        gained: exposure of this step, nats, >= 0.
        fatal: killed outright (a fall).
        graded: health is the share of toughness left, instead of 1 until death.

    Returns:
        Health and exposure after the step.
    """
    xp = array_namespace(health)
    exposure = xp.where(health > 0, exposure + gained, exposure)
    left = 1.0 - exposure / toughness
    lives = (left > 0) & ~fatal
    after = xp.where(lives, left, 0.0) if graded else xp.astype(lives, left.dtype)
    return xp.minimum(after, health), exposure
