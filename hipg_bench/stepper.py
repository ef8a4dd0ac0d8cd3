"""B worlds in memory: where the records of a task lie, and who runs the rules on them.

The rules are in `hipg_bench.engine` and the families, the physics in `hipg_bench.sim`.
"""

from __future__ import annotations

import functools
import os
import sys
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import mujoco
import numpy as np
from jaxtyping import Float, Int

from hipg_bench import engine, native, records
from hipg_bench.families.family import Definition
from hipg_bench.layout import TaskLayout
from hipg_bench.processes import usable_cores
from hipg_bench.records import Field
from hipg_bench.sim import BAD_PHYSICS, QUIET, Sim, columns

_WORTH = 128
"""Worlds per thread from which on another thread pays: to wake one takes 16 to 30 us."""
_POOLED = 4
"""Results that are kept: arrays that nobody holds are used again, for new memory is slow to touch."""


class Results:
    """Arrays that one call fills, and where they are.

    Attributes:
        observation, state: (B, N, O) and (B, S) float32.
        buffer: bytes of all the others, see `hipg_bench.families.family.Results`.
        addresses: of the records in them, in the order of `_TOLD`.
    """

    def __init__(self, num_envs: int, layout: TaskLayout, agents: int, kind: np.dtype[np.void]) -> None:
        self.observation = np.empty((num_envs, agents, layout.observation.size), np.float32)
        self.state = np.empty((num_envs, layout.state.size), np.float32)
        self.buffer = np.empty(kind.itemsize, np.uint8)
        self._places = {
            name: (part.shape, part.base, offset) for name, (part, offset, *_) in (kind.fields or {}).items()
        }
        observation, state, buffer = (
            array.__array_interface__["data"][0] for array in (self.observation, self.state, self.buffer)
        )
        terms, metrics = (buffer + self._places[name][2] for name in ("terms", "metrics"))
        self.addresses = np.array(
            [observation, observation, observation, state, buffer, terms, terms, metrics, metrics], np.int64
        )

    def __getitem__(self, name: str) -> np.ndarray:
        """One of the arrays in the buffer."""
        shape, number, offset = self._places[name]
        return np.ndarray(shape, number, self.buffer, offset)

    @property
    def free(self) -> bool:
        """Whether nobody else holds an array, or a view of one."""
        # the attribute and the call's argument
        return (
            sys.getrefcount(self.observation) == 2
            and sys.getrefcount(self.state) == 2
            and sys.getrefcount(self.buffer) == 2
        )


_OF_A_FAMILY = {
    "world": "World", "previous": "Previous", "scratch": "Scratch", "task": "Numbers", "terms": "Terms",
    "metrics": "Metrics",
}  # fmt: skip
"""Kinds of records that a family declares, and how it calls them."""
_TOLD = ("observation", "observed", "stacked", "state", "results", "terms", "term", "metrics", "metric")
"""Kinds of records in which results are written."""


class Stepper:
    """Steps, begins and observes B worlds.

    Attributes:
        definition: of the task.
        sim: the physics.
        worlds: (B,) records, views of the rows.
        results: what the last call filled.
    """

    def __init__(
        self, definition: Definition, model: mujoco.MjModel, num_envs: int, *, threads: int, compiled: bool
    ) -> None:
        """Allocate the worlds; ``compiled`` is off where tests run the rules as Python."""
        self.definition = definition
        self.sim = sim = Sim(model, num_envs, decimation=definition.physics_steps, threads=threads)
        agents = definition.spec.num_agents
        self._compiler = native.for_processor if compiled and native.compiles() else None
        kinds, types = self._kinds(sim, num_envs)
        self._types = types
        self._memory = memory = native.Memory(kinds, types, self._compiler)
        self.worlds = sim.rows.view(types["world"])[:, 0]
        self._task = numbers_of(definition, model)
        self._scratch = np.zeros(sim.threads, types["scratch"])
        self._previous = np.zeros(num_envs, types["previous"])
        self._history = np.zeros(num_envs * agents, types["history"])
        for name, array in {
            "world": sim.rows, "row": sim.rows, "default": sim.default, "warning": sim.batch.warning,
            "disabled": sim.disabled, "previous": self._previous, "scratch": self._scratch,
            "task": self._task, "history": self._history,
        }.items():  # fmt: skip
            memory.bind(name, array)
        self._pool: list[Results] = []
        self._told = memory.places(_TOLD)
        self._run = native.link(engine.run, memory, definition.rules, compiler=self._compiler)
        self._argument = native.argument(memory, self._compiler)
        self.results = self._new_results()

    def advance(self, action: Float[np.ndarray, "B N A"]) -> int:
        """Step all worlds; return how many episodes ended, -1 if a live agent's action is not finite."""
        self._memory.bind("action", action)
        if self._run(self._argument, engine.CHECK, 0, len(action), 0):
            return -1
        self._run(self._argument, engine.PREPARE, 0, len(action), 0)
        self.sim.advance()
        self.fresh()
        return self._on_threads(engine.ADVANCE, len(action))

    def begin(
        self,
        ids: Int[np.ndarray, "n"],
        episodes: Int[np.ndarray, "n"],
        random: Float[np.ndarray, "n C"],
    ) -> None:
        """Begin episodes in worlds ``ids``, and observe them; the results of other worlds stay."""
        self._memory.bind("random", random)
        self._start(engine.BEGIN, ids, episodes)

    def observe(self, ids: Int[np.ndarray, "n"]) -> None:
        """Observe worlds ``ids`` as they stand; the results of other worlds stay."""
        self._start(engine.OBSERVE, ids, np.zeros_like(ids))

    def fresh(self) -> None:
        """Give the results other arrays, so that those of the last call stay the caller's."""
        self.results = next((results for results in self._pool if results.free), None) or self._new_results()
        self._memory.table[self._told] = self.results.addresses
        if self._compiler is None:
            self._bind_for_python()

    def _new_results(self) -> Results:
        definition = self.definition
        results = Results(
            len(self.worlds), definition.layout, definition.spec.num_agents, self._types["results"]
        )
        if len(self._pool) < _POOLED:
            self._pool.append(results)
        return results

    def _bind_for_python(self) -> None:
        results, bind = self.results, self._memory.bind
        for name, array in zip(
            _TOLD,
            (results.observation, results.observation, results.observation, results.state, results.buffer,
             results["terms"], results["terms"], results["metrics"], results["metrics"]),
            strict=True,
        ):  # fmt: skip
            bind(name, array)

    def _start(self, what: int, ids: np.ndarray, episodes: np.ndarray) -> None:
        starts: Any = np.empty(len(ids), self._types["start"])
        starts["world"], starts["episode"] = ids, episodes
        self._memory.bind("start", starts)
        self._run(self._argument, what, 0, len(ids), 0)

    def _on_threads(self, what: int, worlds: int) -> int:
        parts = max(1, min(self.sim.threads, worlds // _WORTH))
        if parts == 1 or self._compiler is None:
            return self._run(self._argument, what, 0, worlds, 0)
        cuts = [worlds * k // parts for k in range(parts + 1)]
        others = [
            _pool().submit(self._run, self._argument, what, cuts[k], cuts[k + 1], k) for k in range(1, parts)
        ]
        return self._run(self._argument, what, 0, cuts[1], 0) + sum(other.result() for other in others)

    def _kinds(self, sim: Sim, num_envs: int) -> tuple[dict[str, tuple[Field, ...]], dict[str, Any]]:
        """Entries of each kind of record, and NumPy's types of them."""
        definition, layout = self.definition, self.definition.layout
        own = {name: getattr(definition.family, kind) for name, kind in _OF_A_FAMILY.items()}
        kinds = {name: records.fields(kind) for name, kind in {**engine.RECORDS, **own}.items()}
        kinds["observation"] = records.layout_fields(layout.observation)
        kinds["state"] = records.layout_fields(layout.state)
        own_sizes = {
            "B": num_envs, "R": sim.rows.shape[1], "O": layout.observation.size,
            "K": layout.previous, "T+1": len(definition.terms) + 1, "metrics": len(kinds["metrics"]),
            "C": definition.num_random, "warnings": sim.batch.warning.shape[1],
        }  # fmt: skip
        if taken := sorted(own_sizes.keys() & definition.sizes.keys()):
            raise TypeError(f"{definition.spec.family}: the engine's own axes are called {', '.join(taken)}")
        sizes = {**definition.sizes, **own_sizes}
        types = {name: records.dtype(entries, sizes) for name, entries in kinds.items()}
        types["world"] = row_type(definition, sim.model)
        types["observation"], types["state"] = map(records.packed, (layout.observation, layout.state))
        # a family's terms are the first numbers of a row of terms, behind which the floor's is
        types["terms"] = _of_size(types["terms"], types["term"].itemsize)
        types["stacked"] = _of_size(types["stacked"], types["observed"].itemsize)
        # where observations are not stacked, a record of nothing must still be somewhere
        types["history"] = _of_size(types["history"], max(1, types["history"].itemsize))
        return kinds, types


def numbers_of(definition: Definition, model: mujoco.MjModel) -> np.ndarray:
    """A task's numbers, as rules know them: one record."""
    spec, layout = definition.spec, definition.layout
    moved = [columns(model, name) for name in ("QPOS", "QVEL", "WARMSTART")]
    numbers = {
        "horizon": spec.horizon,
        "control_step": spec.control_step,
        "reference_steps": spec.control_step / 0.1,
        "floor": spec.floor,
        "graded_health": spec.graded_health,
        "clip_actions": spec.clip_actions,
        "blank_dead": spec.dead_observation == "blank",
        "dead_value": layout.dead_value,
        "health_column": layout.observation.slices[layout.health_block].start,
        "weights": [spec.weights[name] for name in definition.terms],
        "bad": BAD_PHYSICS,
        "quiet": QUIET,
        "coordinates": [(part.start, part.stop) for part in moved],
        **definition.family.numbers(spec, definition.params),
    }
    record: Any = np.zeros(1, records.dtype(records.fields(definition.family.Numbers), definition.sizes))
    for name, value in numbers.items():
        record[name] = value
    return record


def row_type(definition: Definition, model: mujoco.MjModel) -> np.dtype[np.void]:
    """A row of MuJoCo's state as a record: what physics moves where it lies there, the rest in ``userdata``.

    Raises:
        TypeError: fields of the family that do not fill a component of the state.
    """
    entries = {field.name: field for field in records.fields(definition.family.World)}
    places: dict[str, tuple[tuple[int, ...], int]] = {}
    for component, names in {**definition.family.PHYSICS, "USERDATA": tuple(definition.memory)}.items():
        part = columns(model, component)
        start = part.start
        for name in names:
            axes = records.shape(entries[name], definition.sizes)
            places[name] = axes, start
            start += int(np.prod(axes, dtype=int))
        if start != part.stop:
            raise TypeError(
                f"{definition.spec.task}: {names} hold {start - part.start} of {component}'s numbers"
            )
    size = mujoco.mj_stateSize(model, int(mujoco.mjtState.mjSTATE_INTEGRATION))
    return np.dtype({
        "names": list(entries), "formats": [(np.float64, places[name][0]) for name in entries],
        "offsets": [8 * places[name][1] for name in entries], "itemsize": 8 * size,
    })  # fmt: skip


def _of_size(kind: np.dtype[np.void], size: int) -> np.dtype[np.void]:
    """The same record with room after its last entry."""
    entries = records.places(kind)
    return np.dtype({
        "names": list(entries), "formats": [(number, shape) for shape, number, _ in entries.values()],
        "offsets": [offset for _, _, offset in entries.values()], "itemsize": size,
    })  # fmt: skip


@functools.cache
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(usable_cores(), thread_name_prefix="hipg-worlds")


if hasattr(os, "register_at_fork"):
    # a forked child has none of its parent's threads
    os.register_at_fork(after_in_child=_pool.cache_clear)
