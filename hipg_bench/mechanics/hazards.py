"""Where it is dangerous, and how much hazard that adds."""

from __future__ import annotations

import math


def risk(distance: float, radius: float, peak: float) -> float:
    """Chance of death per 0.1 s at a distance from a hazard: ``peak * max(0, 1 - (d / radius)^2)``.

    Source: the authors' hazard law.

    Args:
        distance: to the hazard's centre, m.
        radius: beyond it nothing happens, m.
        peak: the chance at the centre, in [0, 1).
    """
    share = distance / radius
    return peak * max(1.0 - share * share, 0.0)


def hazard_rate(probability: float, steps: float) -> float:
    """Cumulative hazard gained in a control step, nats, from the chance of death per reference step.

    Args:
        probability: chance of death per reference step of 0.1 s, in [0, 1).
        steps: control step in reference steps, so that the law does not depend on the control rate.
    """
    return -steps * math.log1p(-probability)
