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


@pytest.mark.parametrize(
    ("died_at", "expected"),
    [({}, (1.0, 0.0, np.nan)), ({0: 9.0, 2: 4.0}, (0.5, 2.0, 4.0)), ({1: 2.0}, (0.75, 1.0, 2.0))],
)
def test_common_metrics_by_hand(died_at: dict[int, float], expected: tuple[float, float, float]):
    """Four drones in the last step of an episode of ten, some of whom died before."""
    env = make("hazard_nav-4", 1, threads=1, horizon=10, hazard_peak=0.0)
    env.reset()
    times, health = np.full(4, -1.0), np.ones(4)
    for agent, time in died_at.items():
        times[agent], health[agent] = time, 0.0
    env.arrange(elapsed=9.0, episode_return=-3.5, death_time=times, health=health)
    step = env.step(np.zeros((1, 4, 3)))
    metrics = {name: value[0] for name, value in step.info["metrics"].items()}
    assert (metrics["length"], metrics["return"]) == (10.0, -3.5 + step.reward[0])
    found = metrics["survival"], metrics["deaths"], metrics["first_death"]
    np.testing.assert_array_equal(found, expected)


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
