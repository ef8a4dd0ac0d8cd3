"""Where the curves of a run are shown while it trains: TensorBoard always, wandb or trackio where asked for.

Every value stands over environment steps, under a tag with its group: ``evaluation/`` of the periodic
evaluations, ``episodes/`` of the training's own episodes, ``learner/`` of the update.
"""

from __future__ import annotations

import hashlib
import importlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

from torch.utils.tensorboard import SummaryWriter
from torch.utils.tensorboard.summary import hparams

from hipg_bench.errors import HipgError, UnknownNameError, hint

_EVALUATION = {"eval_return", "score", "score_low", "score_high"}
_LEARNER = {
    "kl", "entropy", "entropy_coef", "actor_rate", "value_loss", "explained", "value", "noise", "epsilon",
}  # fmt: skip
SERVICES = ("wandb", "trackio")
"""What `open_tracker` knows beside TensorBoard; their functions have the same names."""
_PROJECT = "hipg-bench"


@runtime_checkable
class Tracker(Protocol):
    """Takes what a run logs."""

    def log(self, values: Mapping[str, float], steps: int) -> None:
        """Take the values of an iteration, by tag, after so many environment steps."""
        ...

    def close(self) -> None:
        """Write what is left."""
        ...


def tag(name: str) -> str:
    """The name of a logged value with its group."""
    if name in _EVALUATION:
        return f"evaluation/{name.removeprefix('eval_')}"
    return f"{'learner' if name in _LEARNER else 'episodes'}/{name}"


class TensorBoard:
    """Event files in a folder."""

    def __init__(self, folder: Path, settings: Mapping[str, Any], steps: int) -> None:
        """Begin, or resume after so many environment steps: what was logged beyond them is withdrawn."""
        self._writer = SummaryWriter(str(folder), purge_step=steps + 1 if steps else None)
        events = self._writer.file_writer
        if steps == 0 and events is not None:
            metrics = dict.fromkeys((tag("score"), tag("eval_return")), 0.0)
            for summary in hparams(_flat(settings), metrics):
                events.add_summary(summary)  # add_hparams makes a folder of its own

    def log(self, values: Mapping[str, float], steps: int) -> None:
        """See `Tracker`."""
        for name, value in values.items():
            self._writer.add_scalar(name, value, steps)

    def close(self) -> None:
        """See `Tracker`."""
        self._writer.close()


class Service:
    """A run of wandb or trackio, offline or online as their own settings say."""

    def __init__(self, name: str, out: Path, settings: Mapping[str, Any]) -> None:
        """Begin, or resume the run of the same folder.

        Raises:
            HipgError: the package is not installed.
        """
        try:
            self._module: Any = importlib.import_module(name)
        except ModuleNotFoundError as error:
            raise HipgError(f"--track {name} needs it: pip install 'hipg-bench[{name}]'") from error
        title = f"{settings['task']}-{settings['algorithm']}-seed{settings['seed']}"
        key = f"{title}-{hashlib.sha256(str(out.resolve()).encode()).hexdigest()[:8]}"
        options = {"id": key, "name": title, "dir": str(out)} if name == "wandb" else {"name": key}
        self._module.init(project=_PROJECT, config=dict(settings), resume="allow", **options)

    def log(self, values: Mapping[str, float], steps: int) -> None:
        """See `Tracker`."""
        self._module.log(dict(values), step=steps)

    def close(self) -> None:
        """See `Tracker`."""
        self._module.finish()


def check_services(names: tuple[str, ...]) -> None:
    """Refuse services that `open_trackers` does not know.

    Raises:
        UnknownNameError: there is such a name.
    """
    for name in names:
        if name not in SERVICES:
            raise UnknownNameError(f"--track {name!r}{hint(name, SERVICES)}")


def open_trackers(
    services: tuple[str, ...], out: Path, settings: Mapping[str, Any], steps: int
) -> list[Tracker]:
    """TensorBoard in the run's folder, and the services that were asked for.

    Args:
        services: some of `SERVICES`.
        out: the run's folder.
        settings: the run's, shown as its hyperparameters.
        steps: environment steps that were done before.

    Raises:
        UnknownNameError: no such service.
        HipgError: its package is not installed.
    """
    check_services(services)
    return [
        *(Service(name, out, settings) for name in services),
        TensorBoard(out / "tensorboard", settings, steps),
    ]


def _flat(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Values as TensorBoard takes them: numbers, text and truth values."""
    return {
        name: value if isinstance(value, str | int | float | bool) else json.dumps(value)
        for name, value in settings.items()
    }
