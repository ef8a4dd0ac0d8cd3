"""Layouts: packing, viewing, and that every task's vectors are what their tables say."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import hipg_bench
from hipg_bench import Block, Layout, make

TASKS = sorted(hipg_bench.tasks())
SHAPES = st.lists(st.lists(st.integers(1, 4), min_size=1, max_size=3).map(tuple), min_size=1, max_size=6)


@given(SHAPES, st.lists(st.integers(1, 3), max_size=2).map(tuple), st.integers(0, 2**32 - 1))
def test_what_is_packed_is_found_again(shapes: list[tuple[int, ...]], lead: tuple[int, ...], seed: int):
    rng = np.random.default_rng(seed)
    layout = Layout(tuple(Block(f"block{k}", shape, "1") for k, shape in enumerate(shapes)))
    parts = {block.name: rng.random((*lead, *block.shape), np.float32) for block in layout.blocks}
    flat = layout.pack(parts, lead)
    assert flat.shape == (*lead, layout.size)
    assert flat.dtype == np.float32
    # by hand: blocks one after the other, each flattened in C order
    by_hand = [parts[f"block{k}"].reshape(*lead, -1) for k in range(len(shapes))]
    np.testing.assert_array_equal(flat, np.concatenate(by_hand, axis=-1))
    for block in layout.blocks:
        np.testing.assert_array_equal(layout.view(flat, block.name), parts[block.name])


def test_parts_broadcast_and_names_must_match():
    layout = Layout((Block("a", (1,), "1"), Block("b", (2, 2), "m")))
    flat = layout.pack({"a": np.ones((3, 1)), "b": np.zeros((3, 1, 2)) + 5}, (3,))
    assert flat.tolist() == [[1, 5, 5, 5, 5]] * 3
    for parts in ({"a": np.ones((3, 1))}, {"a": np.ones((3, 1)), "b": np.ones((3, 2, 2)), "c": np.ones(3)}):
        with pytest.raises(ValueError, match="do not match the blocks"):
            layout.pack(parts, (3,))


@pytest.mark.parametrize("task", TASKS)
def test_tables_say_what_tasks_hold(task: str):
    env = make(task, 3, threads=1)
    step, layout = env.reset(), env.layout
    kinds = (
        (layout.observation, step.observation, env.observation_size),
        (layout.state, step.info["state"], env.state_size),
    )
    for part, values, size in kinds:
        assert part.size == size == values.shape[-1]
        names = [block.name for block in part.blocks]
        assert len(names) == len(set(names))
        for block in part.blocks:
            assert block.unit
            assert part.view(values, block.name).shape == (*values.shape[:-1], *block.shape)
    assert layout.action.size == env.action_size
    # at the start all are whole, and the flag columns say so, one per agent
    assert layout.health_columns.shape == (env.num_agents,)
    whole = 1.0 - layout.dead_value
    assert (step.info["state"][:, layout.health_columns] == whole).all()
    assert (layout.observation.view(step.observation, layout.health_block) == whole).all()


@pytest.mark.parametrize("task", TASKS)
def test_the_counterfactual_input_is_the_dead_agents_own(task: str):
    """Overwriting an agent's health column gives the joint state in which it just died there."""
    env = make(task, 2, threads=1)
    alive = env.reset().info["state"]
    dead = env.load_rows(np.arange(2), env.fork(env.rows, {1: 0.0})).info["state"]
    column = env.layout.health_columns[1]
    assert (dead[:, column] == env.layout.dead_value).all()
    expected = alive.copy()
    expected[:, column] = env.layout.dead_value
    derived = {"route"}  # reachability follows from who lives
    columns = np.concatenate([
        np.arange(env.state_size)[columns]
        for name, columns in env.layout.state.slices.items()
        if name not in derived
    ])  # fmt: skip
    np.testing.assert_array_equal(dead[:, columns], expected[:, columns])
