"""The only module that steps MuJoCo.

One row of MuJoCo's integration state is one world: health, toughness and whatever else an episode
remembers live in ``userdata``. Copying a row is snapshot, restore, fork, replay and render.
"""

from __future__ import annotations

import ctypes
import os
import weakref

import mujoco
import numpy as np
from jaxtyping import Float, Int, Int32
from mujoco.batch import Batch

from hipg_bench.processes import usable_cores

BAD_PHYSICS = int(mujoco.mjtWarning.mjWARN_BADQPOS), int(mujoco.mjtWarning.mjWARN_BADQACC) + 1
"""First, and last + 1, of the warnings of motion that is not finite, or huge."""

QUIET = 1
"""Where their counts begin: MuJoCo prints the first of a kind, and writes a file into the working folder."""


_INTEGRATION = mujoco.mjtState.mjSTATE_INTEGRATION


class Sim:
    """B worlds of one model.

    Attributes:
        lost: whether this is a copy in a forked process, where the engine's threads are not: its rows can be
            read, and nothing else may be done with it.
        model: the compiled model.
        rows: (B, R) live view of all worlds.
        default: (R,) the row of a world in the model's default state.
        disabled: (B,) live view of the actuator groups that are cut, as bits.
    """

    def __init__(self, model: mujoco.MjModel, num_envs: int, *, decimation: int, threads: int = 0) -> None:
        """Allocate the worlds.

        Args:
            model: with agent i's actuators in group i.
            num_envs: B.
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
        self.rows: Float[np.ndarray, "B R"] = self.batch.state
        self.default = np.empty(self.rows.shape[1])
        mujoco.mj_getState(model, mujoco.MjData(model), self.default, int(_INTEGRATION))
        self.disabled: Int32[np.ndarray, "B"] = self.batch.expand("opt.disableactuator")
        self.forget_warnings(slice(None))

    @property
    def threads(self) -> int:
        """How many threads run the physics, and may run what else takes long."""
        return self.batch.nthread

    def forget_warnings(self, ids: Int[np.ndarray, "n"] | slice) -> None:
        """Let worlds ``ids`` count as healthy."""
        self.batch.warning[ids, :, 0] = 0
        self.batch.warning[ids, :, 1] = QUIET

    def advance(self) -> None:
        """Run the physics of one control step on all threads."""
        self.batch.step(nstep=self._decimation)


def columns(model: mujoco.MjModel, component: str) -> slice:
    """Columns of a row that hold a component of the state, e.g. ``QPOS``."""
    # components are in the order of their bits
    bit = int(getattr(mujoco.mjtState, f"mjSTATE_{component}"))
    start = mujoco.mj_stateSize(model, int(_INTEGRATION) & (bit - 1))
    return slice(start, start + mujoco.mj_stateSize(model, bit))


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
