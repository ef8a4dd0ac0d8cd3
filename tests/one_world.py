"""Rules called one by one, as Python, on the records of one world."""

from __future__ import annotations

from typing import Any

import numpy as np

from hipg_bench import BatchEnv, native, records
from hipg_bench.stepper import numbers_of, row_type


class OneWorld:
    """A copy of one world of an environment, and room for a step.

    Attributes:
        w, previous, scratch, task, terms: the records that rules are given.
    """

    def __init__(self, env: BatchEnv, world: int = 0) -> None:
        self.definition = env.definition
        family = env.definition.family
        row = env.rows[[world]].view(row_type(env.definition, env.model))[:, 0]
        self.w: Any = row.view(np.recarray)[0]
        self.task: Any = numbers_of(env.definition, env.model).view(np.recarray)[0]
        self.previous, self.scratch, self.terms = (
            self._record(kind) for kind in (family.Previous, family.Scratch, family.Terms)
        )
        self.previous.health[:] = self.w.health

    def call(self, name: str, *arguments: Any) -> Any:
        """Run a rule of the family."""
        nothing = native.Memory({}, {}, None)
        return native.link(self.definition.rules[name], nothing, {}, compiler=None)(*arguments)

    def read(self) -> None:
        """Work out where everything is."""
        self.call("read", self.w, self.scratch, self.task)

    def step(self, name: str) -> None:
        """Run a rule that compares with the step before."""
        self.call(name, self.w, self.previous, self.scratch, self.task)

    def reward(self) -> dict[str, float]:
        """The terms of the reward, before weights."""
        self.call("reward", self.w, self.previous, self.scratch, self.task, self.terms)
        return {name: float(self.terms[name]) for name in self.definition.terms}

    def _record(self, kind: type) -> Any:
        entries = records.fields(kind)
        return np.zeros(1, records.dtype(entries, self.definition.sizes)).view(np.recarray)[0]
