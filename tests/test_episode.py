"""What episodes have in common: their chance, their common metrics, and that steps leave nothing behind."""

from __future__ import annotations

import gc
import tracemalloc

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hipg_bench import episode, make

SEEDS = st.integers(0, 2**64 - 1)


@given(SEEDS, st.lists(st.integers(0, 2**40), min_size=1, max_size=5), st.integers(1, 40))
def test_chance_is_a_stream_of_ones_own_per_episode(seed: int, episodes: list[int], size: int):
    drawn = episode.draw(seed, np.array(episodes), size)
    for row, number in zip(drawn, episodes, strict=True):
        stream = np.random.Generator(np.random.Philox(key=seed, counter=[0, 0, 0, number]))
        assert row.tolist() == stream.random(size).tolist()


def test_common_metrics_by_hand():
    never = episode.NEVER
    field = {
        "death_time": np.array([[never, never], [9.0, never], [4.0, 2.0]]),
        "elapsed": np.array([[5.0], [10.0], [20.0]]),
        "return": np.array([[-1.0], [2.5], [0.0]]),
    }
    metrics = episode.measure(field, np.array([0, 2, 1]))
    assert metrics.keys() == set(episode.METRICS)
    assert metrics["return"].tolist() == [-1.0, 0.0, 2.5]
    assert metrics["length"].tolist() == [5.0, 20.0, 10.0]
    assert metrics["survival"].tolist() == [1.0, 0.0, 0.5]
    assert metrics["deaths"].tolist() == [0.0, 2.0, 1.0]
    np.testing.assert_array_equal(metrics["first_death"], [np.nan, 2.0, 9.0])


@pytest.mark.parametrize("task", ["hazard_nav-4", "hazard_comm-10", "multiwalker-3", "paper_nav-4"])
def test_steps_leave_nothing_behind(task: str):
    """Memory in use after many steps and episodes is that after few."""
    env = make(task, 4, threads=1, horizon=7)
    env.reset()
    action = np.random.default_rng(0).uniform(-1, 1, (4, env.num_agents, env.action_size))

    def used(steps: int) -> int:
        for _ in range(steps):
            env.step(action)
        gc.collect()
        return tracemalloc.get_traced_memory()[0]

    used(60)  # what is made once and kept
    tracemalloc.start()
    try:
        marks = [used(7 * 20) for _ in range(5)]
    finally:
        tracemalloc.stop()
    # a leak grows from each mark to the next; what a first death or link loads is in one of the gaps only.
    # snapshots list what touches, so that their sizes vary a little
    assert min(np.diff(marks)) < 16 * 7 * 20, "bytes that stay"
