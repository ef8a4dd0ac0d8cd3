"""Where it is dangerous."""

from __future__ import annotations

import numpy as np
from array_api_compat import array_namespace
from jaxtyping import Float


def risk(distance: Float[np.ndarray, "..."], radius: float, peak: float) -> Float[np.ndarray, "..."]:
    """Chance of death per 0.1 s at a distance from a hazard: ``peak * max(0, 1 - (d / radius)^2)``.

    Source: the authors' hazard law (facts sheet, section 0, "Hazard test").

    Args:
        distance: to the hazard's centre, m.
        radius: beyond it nothing happens, m.
        peak: the chance at the centre, in [0, 1).
    """
    xp = array_namespace(distance)
    return peak * xp.maximum(1.0 - (distance / radius) ** 2, 0.0)
