"""What all episodes have in common: their chance, what a row remembers of them, and what is measured."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float, Int

from hipg_bench.families.family import Family
from hipg_bench.spec import TaskSpec

NEVER = -1.0
"""Death time of the living."""
METRICS = ("return", "length", "survival", "deaths", "first_death")
"""Names of what `measure` returns."""


def memory_fields(spec: TaskSpec, family: Family) -> dict[str, int]:
    """What an episode remembers: name to how many numbers, in the order of ``userdata``."""
    n = spec.num_agents
    common = {
        "health": n, "exposure": n, "toughness": n, "death_time": n, "death_cause": n,
        "episode_id": 1, "elapsed": 1, "return": 1,
    }  # fmt: skip
    return {**common, **family.fields}


def draw(seed: int, episodes: Int[np.ndarray, "n"], size: int) -> Float[np.ndarray, "n size"]:
    """All chance of some episodes: uniform numbers that depend on the seed and the episode alone."""
    philox = np.random.Philox(key=seed)
    generator, start = np.random.Generator(philox), philox.state
    chance = np.empty((len(episodes), size))
    for row, episode in zip(chance, episodes.tolist(), strict=True):
        # the episode takes the counter's highest word: draws advance the lowest, so streams never meet
        start["state"]["counter"][3] = episode
        philox.state = start
        generator.random(out=row)
    return chance


def measure(
    field: Mapping[str, Float[np.ndarray, "B _"]], ids: Int[np.ndarray, "n"]
) -> dict[str, Float[np.ndarray, "n"]]:
    """Metrics of any task for the episodes that end in worlds ``ids``."""
    died_at = field["death_time"][ids]
    dead = died_at != NEVER
    first = np.where(dead, died_at, np.inf).min(axis=1)
    return {
        "return": field["return"][ids, 0],
        "length": field["elapsed"][ids, 0],
        "survival": 1.0 - dead.mean(axis=1),
        "deaths": dead.sum(axis=1).astype(np.float64),
        # undefined where nobody died
        "first_death": np.where(np.isfinite(first), first, np.nan),
    }  # fmt: skip
