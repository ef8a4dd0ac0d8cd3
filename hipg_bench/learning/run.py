"""A training run in a folder: what it stores, and how it resumes after it was killed."""

from __future__ import annotations

import contextlib
import csv
import dataclasses
import hashlib
import importlib
import io
import json
import platform
import time
from collections.abc import Callable
from importlib import metadata
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import mujoco
import torch

from hipg_bench.claims import Claim
from hipg_bench.errors import HipgError, ResumeError
from hipg_bench.learning import periodic_evaluation, torch_setup
from hipg_bench.learning.settings import AnySettings, MaddpgSettings, QmixSettings, Settings
from hipg_bench.learning.trackers import check_services, open_trackers, tag
from hipg_bench.paths import check_seal, output_folder, remove_partial, write_text
from hipg_bench.policies.network import load_network
from hipg_bench.policies.trained import POLICY, RECORD, read_record
from hipg_bench.registry import task_spec, tasks

_REPLAY = "replay"
"""Folder within the run's for what learners keep on disk beside checkpoints."""

_RESULTS = ("checkpoint.pt", POLICY, "learner.safetensors", "curve.csv", "tensorboard", _REPLAY)
"""What a training writes beside it."""

Log = dict[str, float]


@runtime_checkable
class Learner(Protocol):
    """What carries a run from one iteration to the next.

    Attributes:
        iteration: how many are done.
    """

    iteration: int

    def start(self) -> None:
        """Prepare a run that is not resumed."""
        ...

    def iterate(self) -> Log:
        """Play and learn. Returns what to log."""
        ...

    def save(self, path: Path) -> None:
        """Write a checkpoint, whole or not at all."""
        ...

    def resume(self, path: Path) -> None:
        """Go on from a checkpoint, as if never stopped; ResumeError if it is of a run with other settings."""
        ...

    def save_policy(self, path: Path) -> None:
        """Write the policy file, whole or not at all."""
        ...

    def save_networks(self, path: Path) -> None:
        """Write what an audit needs, whole or not at all, if there is such."""
        ...

    def finish(self) -> None:
        """Remove what only an unfinished run needs."""
        ...


def new_learner(settings: AnySettings, out: Path) -> Learner:
    """Make the settings' learner; what it keeps on disk beside checkpoints lies in ``out / "replay"``.

    Raises:
        HipgError: it is built on TorchRL, which is not installed.
    """
    try:
        module = importlib.import_module(f"hipg_bench.learning.{settings.learner}")
    except ModuleNotFoundError as error:
        if error.name is None or error.name.split(".")[0] not in ("torchrl", "tensordict"):
            raise
        raise HipgError(
            f"algorithm {settings.algorithm!r} needs TorchRL: pip install 'hipg-bench[torchrl]'"
        ) from error
    return module.Trainer(settings, out / _REPLAY)


def train(
    settings: AnySettings,
    out: Path,
    *,
    command: str,
    report: Callable[[int, Log], None] | None = None,
    track: tuple[str, ...] = (),
) -> None:
    """Train in a new folder, or go on where an earlier run with the same settings stopped.

    The folder gets ``checkpoint.pt`` (all that is needed to go on), ``policy.safetensors`` and
    ``curve.csv`` and ``train.json`` (what an agent bundle needs), from MAPPO ``learner.safetensors`` (what an
    audit needs), and TensorBoard events; a kill loses at most one iteration. What MADDPG and QMIX replay
    lies in ``replay`` until they are finished: to take them further than that needs a new folder.

    Every ``eval_every`` steps and at the end the policy is evaluated
    (`hipg_bench.learning.periodic_evaluation`). That is for the curve alone: it changes nothing of the run,
    and the policy that counts is the last one.

    Args:
        settings: the run; ``steps`` may be larger than before.
        out: the folder.
        command: the command line, for the record.
        report: called after every iteration with its number and what was logged.
        track: services that show the run beside TensorBoard, of `trackers.SERVICES`.

    Raises:
        UnknownNameError: no such service.
        ResumeError: the folder holds a run with other settings, a damaged one, or files of somebody's that
            would be overwritten, or another process is training in it.
        BundleError: ``settings.initial_policy`` does not fit.
        HipgError: the learner is built on TorchRL, or tracked by a service, which is not installed.
    """
    check_services(track)
    torch_setup.configure()
    with output_folder(out, RECORD, _RESULTS, "training") as claim:
        remove_partial(out)
        _train_alone(settings, out, claim, command, report, track)


@dataclasses.dataclass(frozen=True)
class Evaluated:
    """What the last periodic evaluation of a run found.

    Attributes:
        steps: environment steps before it.
        episodes: how many were played.
        mean_return: their mean return.
        score: the same on the task's scale, None where it has none.
        score_ci95: ends of the score's 95 % interval over the episodes, None without a score.
    """

    steps: int
    episodes: int
    mean_return: float
    score: float | None
    score_ci95: tuple[float, float] | None


def last_evaluation(out: Path) -> Evaluated | None:
    """The last periodic evaluation in a run's curve, None before the first."""
    with (out / "curve.csv").open(encoding="utf-8", newline="") as file:
        rows = [row for row in csv.DictReader(file) if row.get("eval_return")]
    if not rows:
        return None
    row, record = rows[-1], read_record(out)
    ends = (float(row["score_low"]), float(row["score_high"])) if row.get("score") else None
    return Evaluated(
        steps=int(row["steps"]), episodes=periodic_evaluation.num_episodes(record.task),
        mean_return=float(row["eval_return"]),
        score=float(row["score"]) if ends else None, score_ci95=ends,
    )  # fmt: skip


def _train_alone(
    settings: AnySettings,
    out: Path,
    claim: Claim,
    command: str,
    report: Callable[[int, Log], None] | None,
    track: tuple[str, ...],
) -> None:
    if (out / RECORD).exists():
        _check_same_task(settings.task, out)
        _check_unfinished(settings, out)
    else:
        write_text(out / RECORD, _record(settings, command, 0, 0.0))
    learner = new_learner(settings, out)
    checkpoint, curve, policy = out / "checkpoint.pt", out / "curve.csv", out / POLICY
    rows: list[dict[str, Any]] = []
    if checkpoint.exists():
        check_seal(curve)
        learner.resume(checkpoint)
        rows = _read_curve(curve, learner.iteration)
    else:
        learner.start()
    before = float(rows[-1]["seconds"]) if rows else 0.0
    worlds = periodic_evaluation.PeriodicEvaluation(settings.task, threads=torch.get_num_threads())
    started = time.monotonic()
    with contextlib.ExitStack() as stack:
        done = learner.iteration * settings.num_envs * settings.rollout
        trackers = open_trackers(track, out, settings.model_dump(mode="json"), done)
        for tracker in trackers:
            stack.callback(tracker.close)
        while learner.iteration < settings.iterations:
            log = learner.iterate()
            claim.check()
            learner.save_policy(policy)
            if settings.evaluates_after(learner.iteration):
                log |= worlds.play(load_network(policy))
            seconds = round(before + time.monotonic() - started, 1)
            steps = learner.iteration * settings.num_envs * settings.rollout
            rows.append({"iteration": learner.iteration, "steps": steps, "seconds": seconds, **log})
            for tracker in trackers:
                tracker.log({tag(name): value for name, value in log.items()}, steps)
            if report is not None:
                report(learner.iteration, log)
            # the checkpoint goes last: what it says was done is then on disk
            learner.save_networks(out / "learner.safetensors")
            write_text(curve, _table(rows), sealed=True)
            write_text(out / RECORD, _record(settings, command, steps, seconds))
            learner.save(checkpoint)
    learner.finish()


def _check_same_task(task: str, out: Path) -> None:
    """Refuse to resume a run whose task had other numbers.

    Raises:
        ResumeError: it had, or the record is damaged.
    """
    try:
        before = read_record(out)
    except HipgError as error:
        raise ResumeError(f"{error}; choose another --out") from error
    if before.settings.model_dump().get("task") != before.task:
        raise ResumeError(f"{out / RECORD} is not of `hipg-bench train`: choose another --out")
    if before.task != task:
        raise ResumeError(f"{out} was trained on {before.task}, not {task}: choose another --out")


def _check_unfinished(settings: AnySettings, out: Path) -> None:
    """Refuse to begin again, over a record of somebody else's or a run whose checkpoint is gone.

    Raises:
        ResumeError: there is no checkpoint, and the record is not that of the same run.
    """
    if (out / "checkpoint.pt").exists():
        return
    _check_not_lost(out)
    wanted = json.loads(json.dumps(settings.model_dump()))
    before = read_record(out).settings.model_dump()
    if {**before, "steps": 0} != {**wanted, "steps": 0}:
        raise ResumeError(
            f"{out / RECORD} is of a run with other settings and there is no checkpoint.pt: nothing is "
            f"overwritten; choose another --out"
        )


def _check_not_lost(out: Path) -> None:
    """Refuse to overwrite a run whose checkpoint is gone; a kill loses the first one at most.

    Raises:
        ResumeError: there is such a run.
    """
    curve = out / "curve.csv"
    if not (out / "checkpoint.pt").exists() and curve.exists() and len(curve.read_text().splitlines()) > 2:
        raise ResumeError(
            f"{out} holds a run without its checkpoint.pt: it cannot go on; choose another --out"
        )


def _read_curve(path: Path, iterations: int) -> list[dict[str, Any]]:
    """The rows of the iterations that the checkpoint knows of.

    Raises:
        ResumeError: the file is missing, or has fewer or other rows.
    """
    try:
        text = io.StringIO(path.read_text(encoding="utf-8"))
        rows = list[dict[str, Any]](csv.DictReader(text))[:iterations]
        if len(rows) == iterations and all(float(row["seconds"]) >= 0 for row in rows):
            return rows
    except (OSError, ValueError, KeyError, TypeError, csv.Error):
        pass
    raise ResumeError(f"{path} is missing or damaged: checkpoint.pt is of {iterations} iterations")


def _table(rows: list[dict[str, Any]]) -> str:
    """Rows as CSV; a value that an iteration did not have is left empty."""
    names = list(dict.fromkeys(name for row in rows for name in row))
    text = io.StringIO()
    writer = csv.DictWriter(text, names, lineterminator="\n")
    writer.writeheader()
    for row in rows:
        writer.writerow(
            {name: f"{value:.6g}" if isinstance(value, float) else value for name, value in row.items()}
        )
    return text.getvalue()


def _record(settings: AnySettings, command: str, steps: int, seconds: float) -> str:
    """Everything a model card needs to know about where the weights came from."""
    spec = task_spec(settings.task)  # as it is scored, without the weights of training
    content: dict[str, Any] = {
        "command": command,
        "task": spec.task,
        "task_version": spec.version,
        "task_fingerprint": spec.fingerprint,
        "settings": settings.model_dump(),
        "evaluation": {
            "seed": periodic_evaluation.SEED,
            "episodes": periodic_evaluation.num_episodes(settings.task),
            "exploration": False,
        },
        "env_steps": steps,
        "agent_steps": steps * spec.num_agents,
        "seconds": seconds,
        "threads": torch.get_num_threads(),
        "machine": _processor(),
        "versions": {
            "mujoco": mujoco.__version__,
            "torch": torch.__version__,
            "python": platform.python_version(),
        },
    }
    if spec.task not in tasks():
        content["spec"] = spec.model_dump(mode="json")
    if isinstance(settings, Settings) and settings.initial_policy:
        content["initial_policy_fingerprint"] = hashlib.sha256(
            Path(settings.initial_policy).read_bytes()
        ).hexdigest()[:12]
    if isinstance(settings, MaddpgSettings | QmixSettings):
        content["versions"]["torchrl"] = metadata.version("torchrl")
    return json.dumps(content, indent=2) + "\n"


def _processor() -> str:
    """The model's name; the standard library does not know it on Linux."""
    described = Path("/proc/cpuinfo")
    lines = described.read_text().splitlines() if described.exists() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()
