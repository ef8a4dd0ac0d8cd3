"""Random numbers of an episode."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int


def draw(seed: int, episodes: Int[np.ndarray, "n"], size: int) -> Float[np.ndarray, "n size"]:
    """Uniform numbers that depend on the seed and the episode alone."""
    philox = np.random.Philox(key=seed)
    generator, start = np.random.Generator(philox), philox.state
    random = np.empty((len(episodes), size))
    for row, episode in zip(random, episodes.tolist(), strict=True):
        # the episode takes the counter's highest word: draws advance the lowest, so streams never meet
        start["state"]["counter"][3] = episode
        philox.state = start
        generator.random(out=row)
    return random
