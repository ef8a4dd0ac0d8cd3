"""Every rule as plain Python, with bounds checked, is the oracle of its machine code."""

import dataclasses

import numpy as np
import pytest
from play import flat, play, same

import hipg_bench
from hipg_bench import BatchEnv, Layout
from hipg_bench.registry import definition_of

STEPS = 24
"""Enough for a casualty and, with the horizon below, for two episodes."""
HORIZON = 15


def assert_alike(task: str, **changes) -> None:
    machine, plain = (
        hipg_bench.make(task, 3, seed=5, threads=1, compiled=compiled, horizon=HORIZON, **changes)
        for compiled in (True, False)
    )
    first, oracle = machine.reset(), plain.reset()
    dead = 0
    steps = zip([first, *play(machine, first, STEPS)], [oracle, *play(plain, oracle, STEPS)], strict=True)
    for k, (got, expected) in enumerate(steps):
        arrays, wanted = flat(got), flat(expected)
        assert arrays.keys() == wanted.keys()
        wrong = [name for name in arrays if not same(arrays[name], wanted[name])]
        assert not wrong, f"step {k}: {wrong}"
        dead += int((~got.info["final_alive"]).sum())
    assert same(machine.rows, plain.rows)
    assert dead, "no agent was lost: nothing of the dead was compared"


@pytest.mark.parametrize("task", hipg_bench.tasks())
def test_machine_code_does_what_the_rules_say(task):
    assert_alike(task)


@pytest.mark.parametrize("task", ["hazard_nav-4", "hazard_comm-10", "paper_nav-4", "paper_comm-10"])
@pytest.mark.parametrize("change", [{"graded_health": True}, {"dead_observation": "live"}])
def test_machine_code_follows_the_variants(task, change):
    assert_alike(task, **change)


def swapped(layout: Layout, first: str, second: str) -> Layout:
    """A layout with two blocks in each other's place."""
    order = {first: second, second: first}
    named = {block.name: block for block in layout.blocks}
    return Layout(tuple(named[order.get(block.name, block.name)] for block in layout.blocks))


@pytest.mark.parametrize(
    ("task", "observed", "joint"),
    [
        ("hazard_nav-4", ("position", "point_gap"), ("health", "point_position")),
        ("hazard_comm-10", ("health", "wreck_position"), ("route", "hazard_position")),
        ("multiwalker-3", ("height", "neighbor_gap"), ("down", "joint_rate")),
        ("multiwalker_planar-3", ("up", "head_on_plank"), ("place", "plank_lie")),
        ("paper_nav-4", ("terminated", "other_count"), ("velocity", "point_hazardous")),
        ("paper_comm-10", ("position", "dead_position"), ("terminated", "hazard_position")),
    ],
)
def test_swapping_two_blocks_of_a_layout_moves_them_and_changes_nothing_else(task, observed, joint):
    definition = definition_of(hipg_bench.task_spec(task).override(horizon=HORIZON))
    layout = definition.layout
    observation = swapped(layout.observation, *observed)
    if layout.previous:  # what repeats the step before has the same order
        observation = swapped(observation, *(f"previous_{name}" for name in observed))
    other = dataclasses.replace(layout, observation=observation, state=swapped(layout.state, *joint))
    ours, theirs = (
        BatchEnv(dataclasses.replace(definition, layout=each), 2, 5, threads=1, compiled=False)
        for each in (layout, other)
    )
    first, second = ours.reset(), theirs.reset()
    for one, two in zip(play(ours, first, 12), play(theirs, second, 12), strict=True):
        for block in layout.observation.blocks:
            a, b = (
                layout.observation.view(one.observation, block.name),
                observation.view(two.observation, block.name),
            )
            assert same(np.ascontiguousarray(a), np.ascontiguousarray(b)), block.name
        for block in layout.state.blocks:
            a, b = (
                each.state.view(step.info["state"], block.name)
                for each, step in ((layout, one), (other, two))
            )
            assert same(np.ascontiguousarray(a), np.ascontiguousarray(b)), block.name
        assert same(one.reward, two.reward)
