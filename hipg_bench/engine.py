"""What a control step is, for one world; then the loop over worlds.

Read `prepare`, then `step`, from top to bottom: the life of a control step before and after the physics.
A world ``w`` is its row of MuJoCo's state, seen as a record; ``previous`` holds what the step is compared
with, ``scratch`` what a step works out and forgets, ``task`` the numbers of the task. ``rules`` is the
family: plain functions of one world, see `hipg_bench.families.family`. `hipg_bench.native.link` compiles all
of it together, once per family.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Float32, Int, Int32

from hipg_bench.families.family import NEVER, Numbers, Previous, Scratch, World

RUNNING, HORIZON, PHYSICS = 0, 1, 2
"""Why an episode ends; the reasons of a family come after these."""
CHECK, PREPARE, ADVANCE, BEGIN, OBSERVE = range(5)
"""What `run` is asked for."""

Memory = Int[np.ndarray, "K"]


# --- records of the engine, beside those of the family -------------------------------------------------


class Results:
    """What the engine tells of all worlds after a step."""

    reward: Float[np.ndarray, "B"]
    terms: Float[np.ndarray, "B T+1"]
    metrics: Float[np.ndarray, "B metrics"]
    health: Float[np.ndarray, "B N"]
    episode_id: Int[np.ndarray, "B"]
    elapsed: Int[np.ndarray, "B"]
    reason: Int32[np.ndarray, "B"]
    terminated: Bool[np.ndarray, "B"]
    truncated: Bool[np.ndarray, "B"]
    alive: Bool[np.ndarray, "B N"]
    final_alive: Bool[np.ndarray, "B N"]


class Row:
    """All numbers of a world."""

    number: Float[np.ndarray, "R"]


class Warnings:
    """What MuJoCo warns of, per kind: a detail, and how often."""

    count: Int32[np.ndarray, "warnings 2"]


class Disabled:
    """Actuator groups that are cut, as bits."""

    groups: Int32[np.ndarray, ""]  # one number


class TermRow:
    """A family's terms as numbers, then what makes up for diverged physics."""

    number: Float[np.ndarray, "T+1"]


class MetricRow:
    """A family's metrics as numbers."""

    number: Float[np.ndarray, "metrics"]


class Observed:
    """An agent's observation as numbers."""

    number: Float32[np.ndarray, "O"]


class Stacked:
    """An agent's observation where it is stacked: of this step, then of the one before."""

    current: Float32[np.ndarray, "K"]
    before: Float32[np.ndarray, "K"]


class History:
    """What an agent observed in the step before, where observations are stacked."""

    number: Float32[np.ndarray, "K"]


class Action:
    """A team's action."""

    number: Float[np.ndarray, "N A"]


class Start:
    """A world that is to begin an episode, or to be observed."""

    world: int
    episode: int


class Random:
    """Uniform numbers of an episode that is to begin."""

    number: Float[np.ndarray, "C"]


RECORDS: Mapping[str, type] = {
    "results": Results, "row": Row, "default": Row, "warning": Warnings, "disabled": Disabled,
    "term": TermRow, "metric": MetricRow, "observed": Observed, "stacked": Stacked,
    "history": History,
    "action": Action, "start": Start, "random": Random,
}  # fmt: skip
"""In a rule, ``<name>_at(memory, k)`` is the k-th record of this kind."""

# put in by `link`: the family, and the functions that find records
rules: Any
world_at: Any
previous_at: Any
scratch_at: Any
task_at: Any
terms_at: Any
metrics_at: Any
observation_at: Any
state_at: Any
results_at: Any
row_at: Any
default_at: Any
warning_at: Any
disabled_at: Any
term_at: Any
metric_at: Any
observed_at: Any
stacked_at: Any
history_at: Any
action_at: Any
start_at: Any
random_at: Any


# --- one world -----------------------------------------------------------------------------------------


def is_finite(w: World, action: Float[np.ndarray, "N A"]) -> bool:
    """Whether every action of a live agent is a number."""
    for i in range(len(action)):
        for k in range(action.shape[1]):
            if not math.isfinite(action[i, k]) and w.health[i] > 0:
                return False
    return True


def prepare(
    w: World, previous: Previous, scratch: Scratch, task: Numbers, action: Float[np.ndarray, "N A"]
) -> None:
    """Write the actuators' inputs before the physics; what the dead are told is ignored."""
    agents, axes = action.shape
    for i in range(agents):
        previous.health[i] = w.health[i]
        for k in range(axes):
            wanted = min(max(action[i, k], -1.0), 1.0) if task.clip_actions else action[i, k]
            if task.graded_health:
                wanted *= w.health[i]
            scratch.command[i, k] = wanted if w.health[i] > 0 else 0.0
    rules.act(w, previous, scratch, task, scratch.command)


def step(
    w: World, previous: Previous, scratch: Scratch, task: Numbers, memory: Memory, b: int, diverged: bool
) -> None:
    """Work out what a control step made of a world, after the physics."""
    out, agents = results_at(memory, 0), len(w.health)
    rules.read(w, scratch, task)

    # harm becomes death
    w.elapsed += 1
    for i in range(agents):
        scratch.harm[i], scratch.fatal[i], scratch.cause[i] = 0.0, False, 0
    rules.harm(w, previous, scratch, task)
    for i in range(agents):
        if scratch.harm[i] > 0 or scratch.fatal[i]:
            apply_damage(w, scratch, task, i)
    rules.update(w, previous, scratch, task)

    # the team is rewarded, and the episode may end
    rules.reward(w, previous, scratch, task, terms_at(memory, b))
    reason = PHYSICS if diverged else rules.end(w, scratch, task)
    if reason == RUNNING and w.elapsed >= task.horizon:
        reason = HORIZON
    term, count, reward = term_at(memory, b).number, len(task.weights), 0.0
    for k in range(count):
        term[k] = 0.0 if diverged else task.weights[k] * term[k]
        reward += term[k]
    # a diverged episode returns the floor, so that breaking the physics never pays
    term[count] = task.floor - w.episode_return if diverged else 0.0
    reward += term[count]
    w.episode_return += reward

    out.reward[b], out.reason[b] = reward, reason
    out.truncated[b], out.terminated[b] = reason == HORIZON, reason != RUNNING and reason != HORIZON
    for i in range(agents):
        out.final_alive[b, i] = w.health[i] > 0
    measure(w, scratch, task, memory, b, reason != RUNNING)
    observe(w, scratch, task, memory, b)


def apply_damage(w: World, scratch: Scratch, task: Numbers, i: int) -> None:
    """Turn an agent's harm of a step into health. Health never rises, and the dead gain no hazard.

    Each agent draws a hazard threshold E ~ Exp(1) at reset. A step that kills with probability p adds
    -log(1 - p) to its cumulative hazard; it dies when that reaches the threshold. The chance of outliving
    steps p1, p2, ... is then exp(-sum(-log(1 - pk))) = prod(1 - pk): exactly the law of one independent coin
    per step, while the step itself is deterministic.
    """
    before = w.health[i]
    if before > 0:
        w.cumulative_hazard[i] += scratch.harm[i]
    left = 1.0 - w.cumulative_hazard[i] / w.hazard_threshold[i]
    after = left if task.graded_health else 1.0
    w.health[i] = min(before, 0.0 if left <= 0 or scratch.fatal[i] else after)
    if w.health[i] == 0 and before > 0:
        w.death_time[i], w.death_cause[i] = w.elapsed, scratch.cause[i]


def measure(w: World, scratch: Scratch, task: Numbers, memory: Memory, b: int, over: bool) -> None:
    """Write the metrics of an episode that is over; NaN before."""
    metric, agents = metric_at(memory, b).number, len(w.health)
    if not over:
        for k in range(len(metric)):
            metric[k] = math.nan
        return
    metrics, deaths, first = metrics_at(memory, b), 0, math.inf
    for i in range(agents):
        if w.death_time[i] != NEVER:
            deaths += 1
            first = min(first, w.death_time[i])
    metrics.episode_return, metrics.length = w.episode_return, w.elapsed
    metrics.survival, metrics.deaths = 1.0 - deaths / agents, deaths
    metrics.first_death = first if deaths > 0 else math.nan
    rules.metrics(w, scratch, task, metrics)


def observe(w: World, scratch: Scratch, task: Numbers, memory: Memory, b: int) -> None:
    """Write what each agent observes, blank for the dead where the task says so, and the joint state."""
    out, agents = results_at(memory, 0), len(w.health)
    out.episode_id[b], out.elapsed[b] = int(w.episode_id), int(w.elapsed)
    rules.survey(w, scratch, task)
    for i in range(agents):
        out.health[b, i], out.alive[b, i] = w.health[i], w.health[i] > 0
        number, past = observed_at(memory, b * agents + i).number, history_at(memory, b * agents + i).number
        if w.health[i] > 0 or not task.blank_dead:
            rules.observe(w, scratch, task, i, observation_at(memory, b * agents + i))
            # a stacked observation ends with that of the step before
            stacked = stacked_at(memory, b * agents + i)
            current, before = stacked.current, stacked.before
            for k in range(len(past)):
                before[k] = past[k]
            for k in range(len(past)):
                past[k] = current[k]
        else:
            for k in range(len(number)):
                number[k] = 0.0
            for k in range(len(past)):
                past[k] = 0.0
            number[task.health_column] = task.dead_value
    rules.state(w, scratch, task, state_at(memory, b))


def look_back(w: World, scratch: Scratch, task: Numbers, memory: Memory, b: int) -> None:
    """Work out again what was observed in the step before, where observations are stacked."""
    agents = len(w.health)
    for i in range(agents):
        past = history_at(memory, b * agents + i).number
        for k in range(len(past)):
            past[k] = 0.0
        if (
            len(past) > 0
            and w.elapsed > 0
            and rules.observe_previous(w, scratch, task, i, observation_at(memory, b * agents + i))
        ):
            number = observed_at(memory, b * agents + i).number
            for k in range(len(past)):
                past[k] = number[k]


def begin(w: World, scratch: Scratch, task: Numbers, random: Float[np.ndarray, "C"], episode: int) -> None:
    """Begin an episode in a world that is as the model has it: N random numbers are the thresholds'."""
    agents = len(w.health)
    for i in range(agents):
        w.health[i], w.hazard_threshold[i], w.death_time[i] = 1.0, -math.log1p(-random[i]), NEVER
    w.episode_id = episode
    rules.begin(w, scratch, task, random[agents:])


def disabled_groups(w: World) -> int:
    """Groups of actuators that are cut: those of the dead."""
    groups = 0
    for i in range(len(w.health)):
        if w.health[i] == 0:
            groups |= 1 << i
    return groups


def return_to_default(row: Any, default: Any, ranges: Int[np.ndarray, "W 2"]) -> None:
    """Put a world whose physics diverged into the model's pose, so that all that is read is finite."""
    for k in range(len(ranges)):
        for column in range(ranges[k, 0], ranges[k, 1]):
            row.number[column] = default.number[column]


# --- some worlds ---------------------------------------------------------------------------------------


def run(memory: Memory, what: int, first: int, last: int, thread: int) -> int:
    """Do one thing in worlds ``first`` to ``last``, or with the episodes of that range that are to begin.

    Returns:
        How many episodes ended, or how many worlds have actions that are not allowed.
    """
    task, scratch, count = task_at(memory, 0), scratch_at(memory, thread), 0
    for k in range(first, last):
        if what == CHECK:
            count += 0 if is_finite(world_at(memory, k), action_at(memory, k).number) else 1
        elif what == PREPARE:
            prepare(world_at(memory, k), previous_at(memory, k), scratch, task, action_at(memory, k).number)
        elif what == ADVANCE:
            w, diverged, quiet = world_at(memory, k), False, task.quiet
            for kind in range(task.bad[0], task.bad[1]):
                diverged = diverged or warning_at(memory, k).count[kind, 1] > quiet
            if diverged:
                return_to_default(row_at(memory, k), default_at(memory, 0), task.coordinates)
            step(w, previous_at(memory, k), scratch, task, memory, k, diverged)
            disabled_at(memory, k).groups = disabled_groups(w)
            count += 1 if results_at(memory, 0).reason[k] != RUNNING else 0
        else:
            b = start_at(memory, k).world
            w, row, warning = world_at(memory, b), row_at(memory, b).number, warning_at(memory, b).count
            if what == BEGIN:
                default = default_at(memory, 0).number
                for column in range(len(row)):
                    row[column] = default[column]
                for kind in range(len(warning)):
                    warning[kind, 0], warning[kind, 1] = 0, task.quiet
                begin(w, scratch, task, random_at(memory, k).number, start_at(memory, k).episode)
            disabled_at(memory, b).groups = disabled_groups(w)
            look_back(w, scratch, task, memory, b)
            rules.read(w, scratch, task)
            observe(w, scratch, task, memory, b)
    return count
