"""The only module that steps MuJoCo.

One row of MuJoCo's integration state is one world: health, toughness and whatever else an episode
remembers live in ``userdata``. Copying a row is snapshot, restore, fork, replay and render.
"""

from __future__ import annotations

import ctypes
import os
import weakref
from collections.abc import Mapping

import mujoco
import numpy as np
from jaxtyping import Bool, Float, Int
from mujoco.batch import Batch

from hipg_bench.processes import usable_cores

_BAD_PHYSICS = slice(int(mujoco.mjtWarning.mjWARN_BADQPOS), int(mujoco.mjtWarning.mjWARN_BADQACC) + 1)
"""Warnings of positions, velocities or accelerations that are not numbers, or huge."""


_QUIET = 1
"""Where their counts begin: MuJoCo prints the first of a kind, and writes a file into the working folder."""


class Sim:
    """B worlds of one model.

    Attributes:
        lost: whether this is a copy in a forked process, where the engine's threads are not: its rows can be
            read, and nothing else may be done with it.
        model: the compiled model; ``nuserdata`` is the sum of ``fields``.
        control: (B, nu) live view of the actuators' inputs.
        position, velocity: (B, nq), (B, nv) live views of the generalised state.
        applied: (B, nv) live view of generalised forces that mechanics add.
        marker: (B, nmocap, 3) live view of the places of points, terminals and hazards, m.
        field: name to (B, size) live view of what an episode remembers.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        num_envs: int,
        fields: Mapping[str, int],
        *,
        decimation: int,
        threads: int = 0,
    ) -> None:
        """Allocate the worlds.

        Args:
            model: with agent i's actuators in group i.
            num_envs: B.
            fields: name to numbers kept per world in ``userdata``.
            decimation: physics steps per control step.
            threads: 0 for all cores that this process may use.
        """
        # a diverged world must keep its row: the environment ends its episode, MuJoCo must not reset it
        model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
        self.model = model
        self.lost = False
        self.batch = Batch(model, num_envs, threads or usable_cores())
        _here.add(self)
        self._decimation = decimation
        self.control = self.batch.bind("ctrl")
        self.position = self.batch.bind("qpos")
        self.velocity = self.batch.bind("qvel")
        self.applied = self.batch.bind("qfrc_applied")
        self.marker = self.batch.bind("mocap_pos")
        userdata = self.batch.bind("userdata")
        ends = np.cumsum(list(fields.values())).tolist()
        self._columns = {
            name: slice(end - size, end) for (name, size), end in zip(fields.items(), ends, strict=True)
        }
        self.field: dict[str, Float[np.ndarray, "B size"]] = {
            name: userdata[:, columns] for name, columns in self._columns.items()
        }
        # a state row holds its components in the order of their bits
        kind = mujoco.mjtState
        before = int(kind.mjSTATE_INTEGRATION) & (int(kind.mjSTATE_USERDATA) - 1)
        self._userdata_start = mujoco.mj_stateSize(model, before)
        self._default = self._default_row()
        self._disabled = self.batch.expand("opt.disableactuator")
        self._bad = self.batch.warning[:, _BAD_PHYSICS, 1]
        self._bad[:] = _QUIET

    @property
    def num_envs(self) -> int:
        """B."""
        return self.batch.nsim

    @property
    def threads(self) -> int:
        """How many threads run the physics, and may run what else takes long."""
        return self.batch.nthread

    def disable(self, dead: Bool[np.ndarray, "B N"]) -> None:
        """Cut every actuator of dead agents: their groups exert no force, whatever they are told."""
        self._disabled[:] = dead @ (1 << np.arange(dead.shape[1]))

    def advance(self) -> Bool[np.ndarray, "B"]:
        """Run one control step on all threads.

        Returns:
            (B,) the worlds whose physics diverged in it; they are put back to the model's default
            pose, so that everything read from them is finite, and must be reset.
        """
        self.batch.step(nstep=self._decimation)
        diverged = (self._bad > _QUIET).any(axis=1)
        if diverged.any():
            self.position[diverged] = self.model.qpos0
            self.velocity[diverged] = 0.0
            self.batch.bind("qacc_warmstart")[diverged] = 0.0
        return diverged

    def reset(self, ids: Int[np.ndarray, "n"]) -> None:
        """Return worlds to the model's defaults, all agents enabled; userdata becomes 0."""
        # what the engine's own reset does to a row, without waking its threads
        self.batch.state[ids] = self._default
        self.batch.warning[ids] = 0
        self._bad[ids] = _QUIET
        self._disabled[ids] = 0

    @property
    def rows(self) -> Float[np.ndarray, "B R"]:
        """Live view of all worlds."""
        return self.batch.state

    def _default_row(self) -> Float[np.ndarray, "R"]:
        """The row of a world in the model's default state."""
        spec = int(mujoco.mjtState.mjSTATE_INTEGRATION)
        row = np.empty(mujoco.mj_stateSize(self.model, spec))
        mujoco.mj_getState(self.model, mujoco.MjData(self.model), row, spec)
        return row

    def userdata_of(self, rows: Float[np.ndarray, "n R"], name: str) -> Float[np.ndarray, "n size"]:
        """View of one remembered field in saved rows."""
        return rows[:, self._userdata_start :][:, self._columns[name]]


_here = weakref.WeakSet[Sim]()
"""What a fork leaves without threads."""


def _lose_threads() -> None:
    """After a fork, in the child: the engine would wait for ever for threads that were not copied.

    It does so when it is destroyed, too; hence one reference more, which is never given back.
    """
    for sim in _here:
        sim.lost = True
        ctypes.pythonapi.Py_IncRef(ctypes.py_object(sim.batch))


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_lose_threads)
