"""Where jobs are run: in processes of this machine, by Ray, or by Slurm.

These schedule; what is done is said by the jobs' folders alone. A job claims its folder, goes on with what
lies in it and leaves the same bytes wherever it is run, so that a driver, a job or a machine may be killed at
any moment, and any number of drivers may share the folders on one disk.
"""

from __future__ import annotations

import abc
import collections
import importlib
import multiprocessing
import os
import signal
import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from multiprocessing import connection
from multiprocessing.connection import Connection
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple

from hipg_bench import processes
from hipg_bench.claims import Claim, HeldError
from hipg_bench.errors import HipgError, SpecError, hint
from hipg_bench.paths import write_text

NAMES = ("local", "ray", "slurm")
"""The launchers."""
ERROR_LOG = "error.log"
"""The file in a job's folder that says why it failed last; removed when it succeeds."""
_HELD = "held by another process"
_LOOK_EVERY = 5.0
"""Seconds between two reports, and between two tries to claim what others hold."""
_TRIES = 16
"""Folders at most that one look tries to claim in vain, so that many drivers do not flood a shared disk."""
_PATIENCE = 5.0
"""Seconds that a process has to end before it is killed."""
_SHARE = {"num_cpus": 1, "num_gpus": 0}
"""What a job takes of a Ray cluster."""
_RETRIES = 5
"""How often Ray starts a job again whose machine or process is gone."""


class Job(NamedTuple):
    """A call that fills a folder.

    Attributes:
        folder: which; claimed by the call.
        call: a function of a module; it raises `HeldError` if another process holds the folder.
        arguments: the call's; they can be pickled.
    """

    folder: Path
    call: Callable[..., None]
    arguments: tuple[Any, ...]


class Launcher(abc.ABC):
    """Starts jobs somewhere; as a context it ends at its end what is still running.

    Attributes:
        slots: jobs at a time, or None if the engine has a queue of its own.
    """

    slots: int | None = None

    def __init__(self) -> None:
        self._running: dict[Any, Job] = {}  # by what the engine calls it

    def __enter__(self) -> Launcher:
        """Connect to the engine."""
        return self

    @abc.abstractmethod
    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """End what still runs, and disconnect; what was finished is on disk."""

    @abc.abstractmethod
    def start(self, jobs: Sequence[Job]) -> None:
        """Start jobs."""

    @abc.abstractmethod
    def wait(self, seconds: float) -> list[tuple[Job, str | None]]:
        """Wait so long or until a job ends; return those that ended with what went wrong, if anything."""


def launcher(name: str, workers: int, options: Mapping[str, Any]) -> Launcher:
    """Make a launcher.

    Args:
        name: one of `NAMES`.
        workers: jobs at a time: of the local launcher, and of a Ray cluster that is started here.
        options: of Ray: ``address`` of a cluster, ``num_cpus`` and ``num_gpus`` per job; of Slurm:
            parameters of submitit, such as ``slurm_partition`` and ``timeout_min``.

    Raises:
        SpecError: no such launcher, or an option that it does not have.
        HipgError: its library is not installed.
    """
    if name not in NAMES:
        raise SpecError(f"--launcher {name!r}: {', '.join(NAMES)} are allowed{hint(name, NAMES)}")
    if name == "local":
        if options:
            raise SpecError(f"--launcher local has no options, got {', '.join(options)}")
        return Local(workers)
    return Ray(workers, options) if name == "ray" else Slurm(workers, options)


def work_off(
    jobs: Sequence[Job], engine: Launcher, finished: Callable[[Job], bool], report: Callable[[], None]
) -> None:
    """Run all jobs that are not finished, and wait for those that other drivers run.

    Args:
        jobs: in the order in which they are started.
        engine: where.
        finished: whether a job's folder holds all of its results.
        report: called every few seconds, and at the end.

    Raises:
        HipgError: what went wrong with the first job that failed; the others end first.
    """
    waiting = collections.deque((job, Claim(job.folder)) for job in jobs if not finished(job))
    claims = {job.folder: claim for job, claim in waiting}
    running, failed = 0, list[str]()
    with engine:
        while waiting or running:
            free = len(waiting) if engine.slots is None else engine.slots - running
            started = _claimable(waiting, free, finished)
            engine.start(started)
            running += len(started)
            ended = engine.wait(_LOOK_EVERY)
            running -= len(ended)
            for job, trouble in ended:
                if trouble == _HELD:
                    waiting.append((job, claims[job.folder]))
                elif trouble is not None:
                    failed.append(f"{job.folder}: {trouble}")
                elif not finished(job):
                    failed.append(f"{job.folder}: it ended without its results")
            report()
    if failed:
        raise HipgError(failed[0])


def _claimable(
    waiting: collections.deque[tuple[Job, Claim]], free: int, finished: Callable[[Job], bool]
) -> list[Job]:
    """Take up to so many jobs from those waiting that no other process works on; drop finished ones."""
    found: list[Job] = []
    tries = 0
    for _ in range(len(waiting)):
        if len(found) >= free or tries >= _TRIES:
            break
        job, claim = waiting.popleft()
        if not claim.take():
            tries += 1
            waiting.append((job, claim))
            continue
        claim.release()  # the job claims it itself, so that the claim names where it runs
        if not finished(job):
            found.append(job)
    return found


def perform(job: Job) -> str | None:
    """Run a job here; return what went wrong, which also stands in its folder's `ERROR_LOG`."""
    processes.leave_out_the_working_folder()
    try:
        job.call(*job.arguments)
    except HeldError:
        return _HELD
    except HipgError as error:
        return _note(job, traceback.format_exc(), str(error))
    except Exception as error:
        return _note(job, traceback.format_exc(), f"{type(error).__name__}: {error}")
    (job.folder / ERROR_LOG).unlink(missing_ok=True)
    return None


def _note(job: Job, log: str, trouble: str) -> str:
    write_text(job.folder / ERROR_LOG, log if log.endswith("\n") else f"{log}\n")
    return trouble


class Local(Launcher):
    """Each job in a process of its own with one thread.

    Args:
        workers: jobs at a time.
    """

    def __init__(self, workers: int) -> None:
        super().__init__()
        self.slots = workers

    def start(self, jobs: Sequence[Job]) -> None:
        """Start a process per job."""
        for job in jobs:
            self._running[_Child(job)] = job

    def wait(self, seconds: float) -> list[tuple[Job, str | None]]:
        """See `Launcher`."""
        children = {child.process.sentinel: child for child in self._running}
        if not children:
            time.sleep(seconds)
        ended = [children[sentinel] for sentinel in connection.wait(list(children), seconds)]  # pyright: ignore[reportArgumentType]
        return [(self._running.pop(child), child.trouble()) for child in ended]

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """End the processes; what they finished is on disk."""
        for child in self._running:
            child.end()


class _Child:
    """A job in a process of its own."""

    def __init__(self, job: Job) -> None:
        context = multiprocessing.get_context("spawn")
        self._job = job
        self._ear, mouth = context.Pipe(duplex=False)
        self.process = context.Process(target=_perform_and_tell, args=(job, mouth), daemon=True)
        os.environ["PYTHONSAFEPATH"] = "1"  # its modules are not taken from the working folder
        # Ctrl-C is for this process, which ends the other one
        before = signal.pthread_sigmask(signal.SIG_BLOCK, (signal.SIGINT,))
        try:
            self.process.start()
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
        mouth.close()

    def trouble(self) -> str | None:
        """What went wrong, once it has ended."""
        self.process.join()
        try:
            return self._ear.recv()
        except EOFError:
            trouble = f"its process ended with code {self.process.exitcode}"
            return _note(self._job, trouble, trouble)

    def end(self) -> None:
        """End it now."""
        self.process.terminate()
        self.process.join(_PATIENCE)
        self.process.kill()


def stop_when_orphaned() -> None:
    """End this process where the driver that started it was killed, which cannot say so any more."""
    driver = multiprocessing.parent_process()
    if driver is not None and not driver.is_alive():
        os._exit(1)


def _perform_and_tell(job: Job, mouth: Connection) -> None:
    mouth.send(perform(job))


class Ray(Launcher):
    """Each job as a task of Ray Core, which starts it again where its machine is gone.

    Args:
        workers: processors of the cluster that is started where no address is given.
        options: ``address``, ``num_cpus`` and ``num_gpus`` per job.
    """

    def __init__(self, workers: int, options: Mapping[str, Any]) -> None:
        super().__init__()
        allowed = ("address", *_SHARE)
        for name in options:
            if name not in allowed:
                raise SpecError(
                    f"--launcher ray has no option {name!r}: {', '.join(allowed)} are allowed"
                    f"{hint(name, allowed)}"
                )
        self._ray = _library("ray", "ray")
        self._address = options.get("address")
        self._workers = workers
        self._resources = {name: options.get(name, default) for name, default in _SHARE.items()}

    def __enter__(self) -> Launcher:
        """Connect to the cluster, or start one."""
        here = {"num_cpus": self._workers, "include_dashboard": False} if self._address is None else {}
        variables = {"PYTHONSAFEPATH": "1", "OMP_NUM_THREADS": "1"}
        self._ray.init(
            address=self._address or "local", runtime_env={"env_vars": variables},
            log_to_driver=False, logging_level="ERROR", **here,
        )  # fmt: skip
        self._perform = self._ray.remote(perform).options(max_retries=_RETRIES, **self._resources)
        return self

    def start(self, jobs: Sequence[Job]) -> None:
        """Put jobs into Ray's queue."""
        for job in jobs:
            self._running[self._perform.remote(job)] = job

    def wait(self, seconds: float) -> list[tuple[Job, str | None]]:
        """See `Launcher`."""
        if not self._running:
            time.sleep(seconds)
            return []
        ended, _ = self._ray.wait(list(self._running), num_returns=1, timeout=seconds)
        more, _ = self._ray.wait(list(self._running), num_returns=len(self._running), timeout=0)
        return [self._ended(one) for one in dict.fromkeys([*ended, *more])]

    def _ended(self, one: Any) -> tuple[Job, str | None]:
        job = self._running.pop(one)
        try:
            return job, self._ray.get(one)
        except self._ray.exceptions.RayError as error:
            return job, _note(job, str(error), str(error).strip().splitlines()[0])

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Cancel what still runs, and disconnect."""
        for one in self._running:
            self._ray.cancel(one, force=True)
        self._ray.shutdown()


class Slurm(Launcher):
    """Each job as an element of a job array, submitted by submitit; requeued when its time is up.

    Args:
        workers: elements of the array that run at a time.
        options: parameters of submitit's executor; ``cluster = "local"`` runs without Slurm, to try it out.
    """

    def __init__(self, workers: int, options: Mapping[str, Any]) -> None:
        super().__init__()
        self._submitit = _library("submitit", "slurm")
        given = dict(options)
        self._cluster = given.pop("cluster", "slurm")
        parallel = {"slurm_array_parallelism": workers} if self._cluster == "slurm" else {}
        if self._cluster != "slurm":
            self.slots = workers
        self._parameters = {
            "name": "hipg-bench",
            "cpus_per_task": 1,
            "timeout_min": 24 * 60,
            **parallel,
            **given,
        }

    def start(self, jobs: Sequence[Job]) -> None:
        """Submit jobs as one array; scripts and logs lie beside their folders."""
        if not jobs:
            return
        logs = Path(os.path.commonpath([job.folder.parent for job in jobs])) / ".slurm"
        try:
            executor = self._submitit.AutoExecutor(folder=logs, cluster=self._cluster)
            executor.update_parameters(**self._parameters)
        except (NameError, TypeError, RuntimeError) as error:
            raise SpecError(f"--launcher slurm: {error}") from error
        with executor.batch():
            submitted = [executor.submit(_Requeued(), job) for job in jobs]
        self._running |= dict(zip(submitted, jobs, strict=True))

    def wait(self, seconds: float) -> list[tuple[Job, str | None]]:
        """See `Launcher`."""
        until = time.monotonic() + seconds
        while not (ended := [one for one in self._running if one.done()]) and time.monotonic() < until:
            time.sleep(0.2)
        return [self._ended(one) for one in ended]

    def _ended(self, one: Any) -> tuple[Job, str | None]:
        job = self._running.pop(one)
        try:
            return job, one.result()
        except self._submitit.core.utils.UncompletedJobError as error:
            return job, _note(job, str(error), str(error).strip().splitlines()[0])

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Cancel what still runs or waits in the queue."""
        for one in self._running:
            one.cancel()


class _Requeued:
    """`perform`, which is submitted again when Slurm says that its time is up."""

    def __call__(self, job: Job) -> str | None:
        """Run the job."""
        return perform(job)

    def checkpoint(self, job: Job) -> Any:
        """Go on in a new submission: the folder holds all but the last iteration."""
        return importlib.import_module("submitit").helpers.DelayedSubmission(self, job)


def _library(name: str, extra: str) -> Any:
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        raise HipgError(f"--launcher {extra} needs {name}: pip install 'hipg-bench[{extra}]'") from error
