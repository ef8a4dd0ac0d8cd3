"""Where few entries of an array hold."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Int


def few(holds: Bool[np.ndarray, "*axes"]) -> tuple[Int[np.ndarray, "n"], ...]:
    """`np.nonzero`, several times faster where few entries of several axes hold."""
    return np.unravel_index(holds.ravel().nonzero()[0], holds.shape)
