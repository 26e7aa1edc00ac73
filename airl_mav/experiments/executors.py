"""Executors of jobs: this process, worker processes or a Ray cluster, with equal results.

Worker processes run job after job; lost ones are replaced. Each has a separate pipe, so a killed
worker cannot block the others. Workers are spawned, never forked: threads of MAVSDK and ONNX
Runtime do not survive a fork. A worker ends with its parent.
"""

from __future__ import annotations

import importlib
import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from types import ModuleType
from typing import Any, ClassVar, Generic, NamedTuple, Protocol, TypeVar

from airl_mav.core.addons import entries
from airl_mav.core.compiling import Heard, heard_compiling
from airl_mav.core.constants import MAX_ATTEMPTS
from airl_mav.core.errors import FieldError, UsageError
from airl_mav.core.fields import quantity
from airl_mav.core.machine import package_versions, usable_cores, version_changes
from airl_mav.rehearsal.run_folder import FlownEpisode, RunFolder
from airl_mav.scenario import aircraft, model, resolve

J = TypeVar("J")
R = TypeVar("R")

Stop = Callable[[], bool]
"""Polled repeatedly; True ends the work."""

Work = Callable[[J], Iterable[R]]
"""Carries out a job and yields its results."""

Start = Callable[[Stop], Work[J, R]]
"""Initializer, called once in each worker to load everything. Sent to workers by pickle. Its
argument is polled for a stop in this process only: other workers are terminated instead."""

Results = Generator[tuple[J, R], None, None]
"""Results in order of completion, each with its job. Closing the generator ends running workers."""

POLL_S = 0.2
"""Interval at which `stop` is polled while waiting for results [wall s]."""

ONE_THREAD = dict.fromkeys(
    ("MKL_NUM_THREADS", "NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1"
)
"""Environment of a worker, which has one core."""


class WorkerError(Exception):
    """Failure of a job; the message contains its name and the reason."""


def never() -> bool:
    """Return False: never stop."""
    return False


class Executor(Protocol):
    """Executor of parallel jobs."""

    @property
    def workers(self) -> int:
        """Number of parallel jobs."""

    @property
    def streams(self) -> bool:
        """True if results are yielded while their job is running, not at its end."""

    def run(
        self,
        jobs: Iterable[J],
        start: Start[J, R],
        *,
        name: Callable[[J], str] = str,
        stop: Stop = never,
        lost: Callable[[str], None] = lambda _: None,
        compiling: Heard = lambda _: None,
    ) -> Results[J, R]:
        """Run jobs, taken lazily, on free workers and yield their results in any order.

        `start` initializes a worker; `stop` is polled several times per second and aborts running
        jobs; `lost` gets a one-line message for each lost worker, whose job restarts without
        partial results; `compiling` is called when local workers begin and end compiling kernels.

        Raises:
            UsageError: A job rejects its input.
            WorkerError: A job failed, or its worker was lost `MAX_ATTEMPTS` times.
        """


class InProcessExecutor:
    """Executor in this process, one job at a time; streams results and raises errors unchanged."""

    workers: ClassVar[int] = 1
    streams: ClassVar[bool] = True

    def run(
        self,
        jobs: Iterable[J],
        start: Start[J, R],
        *,
        name: Callable[[J], str] = str,
        stop: Stop = never,
        lost: Callable[[str], None] = lambda _: None,  # noqa: ARG002 (never lost here)
        compiling: Heard = lambda _: None,
    ) -> Results[J, R]:
        """Run jobs; see `Executor`."""
        work: Work[J, R] | None = None
        with heard_compiling(compiling):
            for job in jobs:
                if stop():
                    return
                try:
                    work = work or start(stop)
                    for result in work(job):
                        yield job, result
                except UsageError as error:
                    raise UsageError(f"{name(job)}: {error}") from None


class ExecutorSettings(model.Workers):
    """Executor of an experiment and the resources of a job."""

    ray_gpus: float = quantity("share of a GPU for each job", "1", ge=0.0, le=8.0, default=0.0)


# --- shared by executors with workers


@dataclass(frozen=True)
class Failure:
    """Answer of a worker for a failed job."""

    message: str
    usage: bool

    def error(self, job: str) -> UsageError | WorkerError:
        """Return the exception for a job of a given name."""
        return (UsageError if self.usage else WorkerError)(f"{job}: {self.message}")


def check_versions(driver: Mapping[str, str]) -> None:
    """Raise UsageError if this worker's versions differ from the driver's `package_versions`."""
    if different := version_changes(package_versions(), driver):
        raise UsageError(
            f"the worker on {os.uname().nodename} has other code: {'; '.join(different)}; accepted:"
            " the same versions on every machine, unchanged during the run"
        )


def answer(work: Callable[[], Iterable[R]]) -> list[R] | Failure:
    """Return a worker's answer: all results of a job, or its failure."""
    try:
        return list(work())
    except UsageError as error:
        return Failure(str(error), usage=True)
    except Exception as error:
        text = f"{type(error).__name__}: {error}" if str(error) else type(error).__name__
        return Failure(" ".join(text.split()), usage=False)


def next_attempt(job: str, attempt: int, cause: str, lost: Callable[[str], None]) -> int:
    """Report a lost worker and return the next attempt's number; WorkerError after the last."""
    if attempt == MAX_ATTEMPTS:
        raise WorkerError(f"{job}: lost {MAX_ATTEMPTS} workers, the last one by {cause}")
    lost(f"a worker was lost by {cause}: {job} begins again")
    return attempt + 1


FlyEpisodes = Callable[[Sequence[resolve.PlannedEpisode]], Iterable[FlownEpisode]]


class Flier(Protocol):
    """Interface to fly the episodes of a scenario. Sent to workers by pickle."""

    def episodes_per_job(self, episodes: int, workers: int) -> int:
        """Return the episodes per job for executors that do not stream results."""

    def start(self, folder: RunFolder, stop: Stop) -> FlyEpisodes:
        """Load everything once; return a function that flies episodes and polls `stop`."""


END_S = 5.0
"""Timeout for an idle worker to exit before it is killed [wall s]."""


class ProcessExecutor:
    """Executor of at most `workers` single-threaded worker processes, shared by several runs."""

    streams: ClassVar[bool] = False

    def __init__(self, workers: int) -> None:
        self.workers = workers
        self._idle: list[_Idle] = []

    def __enter__(self) -> ProcessExecutor:
        """Return the executor; processes start with their first job."""
        return self

    def __exit__(self, *_: object) -> None:
        """End all workers."""
        self.close()

    def run(
        self,
        jobs: Iterable[J],
        start: Start[J, R],
        *,
        name: Callable[[J], str] = str,
        stop: Stop = never,
        lost: Callable[[str], None] = lambda _: None,
        compiling: Heard = lambda _: None,
    ) -> Results[J, R]:
        """Run jobs; see `executors.Executor`. Closing the generator ends only busy workers."""
        waiting = iter(jobs)
        pool: _Pool[J] = _Pool(start, self._idle)
        try:
            while len(pool.busy) < self.workers and not stop():
                try:
                    pool.hire(next(waiting))
                except StopIteration:
                    break
            while pool.busy:
                for connection in wait(list(pool.busy), POLL_S):
                    assert isinstance(connection, Connection)  # noqa: S101 (as they went in)
                    worker = pool.busy[connection]
                    job = worker.job
                    try:
                        told = connection.recv()
                    except (EOFError, OSError):
                        cause = pool.bury(connection)
                        pool.hire(job, next_attempt(name(job), worker.attempt, cause, lost))
                        continue
                    if isinstance(told, _Compiling):
                        worker.compiles = told.begins
                        compiling(any(each.compiles for each in pool.busy.values()))
                        continue
                    if isinstance(told, Failure):
                        raise told.error(name(job))
                    # The worker gets its next job before its results are processed.
                    pool.give(connection, waiting)
                    for result in told:
                        yield job, result
                if stop():
                    return
        finally:
            pool.end()

    def close(self) -> None:
        """End all workers, which must be idle."""
        for idle in self._idle:
            idle.connection.close()
        for idle in self._idle:
            idle.process.join(END_S)
            _remove(idle.process)
        self._idle.clear()


class _Idle(NamedTuple):
    """Idle worker."""

    connection: Connection
    process: BaseProcess


@dataclass
class _Worker(Generic[J]):
    """State of a busy worker in the parent."""

    process: BaseProcess
    job: J
    attempt: int
    """Number of workers that have received this job."""
    compiles: bool = False


class _Pool(Generic[J]):
    """Worker processes of one run."""

    def __init__(self, start: Start[J, Any], idle: list[_Idle]) -> None:
        self._start = start
        self.busy: dict[Connection, _Worker[J]] = {}
        self._idle = idle
        """Idle workers, used before new ones are started."""

    def hire(self, job: J, attempt: int = 1) -> None:
        """Assign a worker to this run and send its first job."""
        worker = self._take_idle() or _spawn()
        self.busy[worker.connection] = _Worker(worker.process, job, attempt)
        _send(worker.connection, ((self._start, package_versions()), job))

    def _take_idle(self) -> _Idle | None:
        """Return an idle worker and remove lost ones; None if there is no idle worker."""
        while self._idle:
            worker = self._idle.pop()
            if worker.process.is_alive():
                return worker
            worker.connection.close()
            _remove(worker.process)
        return None

    def give(self, connection: Connection, waiting: Iterator[J]) -> None:
        """Send a worker its next job, or keep it idle for the next run."""
        worker = self.busy[connection]
        try:
            worker.job, worker.attempt = next(waiting), 1
        except StopIteration:
            del self.busy[connection]
            self._idle.append(_Idle(connection, worker.process))
        else:
            _send(connection, (None, worker.job))

    def bury(self, connection: Connection) -> str:
        """Remove a lost worker; return the cause."""
        process = self.busy.pop(connection).process
        connection.close()
        process.kill()
        process.join()
        cause = _cause(process.exitcode)
        process.close()
        return cause

    def end(self) -> None:
        """Kill all busy workers."""
        for connection, worker in self.busy.items():
            worker.process.kill()
            connection.close()
        for worker in self.busy.values():
            _remove(worker.process)
        self.busy.clear()


def _remove(process: BaseProcess) -> None:
    """Kill a process that is still running, and release its resources."""
    process.kill()
    process.join()
    process.close()


def _send(connection: Connection, job: Any) -> None:
    # A lost worker is detected on reception of its answer.
    with suppress(OSError):
        connection.send(job)


def _spawn() -> _Idle:
    """Start a worker; return the parent's end of its pipe, and the process."""
    context = multiprocessing.get_context("spawn")
    # Otherwise it would start with the first worker, and unblock Ctrl-C again.
    resource_tracker.ensure_running()
    ours, theirs = context.Pipe()
    process = context.Process(target=_serve, args=(theirs,), daemon=True)
    with ExitStack() as stack:
        stack.enter_context(theirs)
        stack.enter_context(_environment(ONE_THREAD))
        stack.enter_context(_interrupts_blocked())
        stack.enter_context(_program_hidden())
        process.start()
    return _Idle(ours, process)


@contextmanager
def _environment(values: dict[str, str]) -> Iterator[None]:
    """Set environment variables temporarily; a new process reads them first."""
    before = {key: os.environ.get(key) for key in values}
    os.environ.update(values)
    try:
        yield
    finally:
        for key, value in before.items():
            if value is None:
                del os.environ[key]
            else:
                os.environ[key] = value


@contextmanager
def _interrupts_blocked() -> Iterator[None]:
    """Block Ctrl-C while starting processes; the parent controls its workers."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextmanager
def _program_hidden() -> Iterator[None]:
    """Hide the user's main module while starting processes: "spawn" would run it again."""
    program = sys.modules["__main__"]
    sys.modules["__main__"] = ModuleType("__main__")
    try:
        yield
    finally:
        sys.modules["__main__"] = program


def _cause(exitcode: int | None) -> str:
    if exitcode is not None and exitcode < 0:
        with suppress(ValueError):
            return signal.Signals(-exitcode).name
    return f"exit status {exitcode}"


# --- in the worker


@dataclass(frozen=True)
class _Compiling:
    """Message of a worker at the start and the end of kernel compilation."""

    begins: bool


def _serve(connection: Connection) -> None:
    """Run jobs until the pipe is closed; the first job of a run includes its initializer."""
    _end_with_parent()
    begin: tuple[Start[Any, Any], Mapping[str, str]] | None = None
    work: Work[Any, Any] | None = None

    def carry_out(job: Any) -> Iterable[Any]:
        nonlocal begin, work
        if begin is not None:
            work = None  # Release the previous run's data first.
            check_versions(begin[1])
            work, begin = begin[0](never), None
        assert work is not None  # noqa: S101 (no run begins without a start)
        return work(job)

    def tell(begins: bool) -> None:
        with suppress(OSError):  # The parent has exited; the answer fails, too.
            connection.send(_Compiling(begins))

    while True:
        try:
            new, job = connection.recv()
        except EOFError:
            return
        begin = new or begin
        with heard_compiling(tell):
            told = answer(partial(carry_out, job))
        try:
            connection.send(told)
        except OSError:  # The parent has exited.
            return


def _end_with_parent() -> None:
    """Start the parent-death guard: it ends this process at any time."""
    parent = multiprocessing.parent_process()
    assert parent is not None  # noqa: S101 (this is a worker)

    def watch() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=watch, name="parent-death-guard", daemon=True).start()


def side_by_side(settings: model.Workers) -> int:
    """Return the maximum of parallel flights; the user starts PX4's instances."""
    if not isinstance(settings, aircraft.Aircraft) or settings.firmware == "builtin":
        return model.GREATEST_WORKERS
    real = settings.real
    return 1 if real.px4_dir is None else aircraft.GREATEST_INSTANCE + 1 - real.instance


@contextmanager
def open_executor(settings: model.Workers, *, in_process: bool = False) -> Iterator[Executor]:
    """Open the configured executor; a single worker may be this process if `in_process`."""
    cores = min(usable_cores(), model.GREATEST_WORKERS)
    if settings.executor != "process":
        known = entries("airl_mav", "EXECUTORS")
        if settings.executor not in known:
            raise FieldError("executor", settings.executor, ", ".join(("process", *known)))
        gpus = settings.ray_gpus if isinstance(settings, ExecutorSettings) else 0.0
        module = importlib.import_module(known[settings.executor])
        with module.connected(settings, cores, gpus) as executor:
            yield executor
        return
    most = side_by_side(settings)
    if settings.workers is not None and settings.workers > most:
        raise FieldError("workers", settings.workers, f"1 <= value <= {most} with this firmware")
    workers = settings.workers or (1 if in_process else min(cores, most))
    if in_process and workers == 1:
        yield InProcessExecutor()
        return
    with ProcessExecutor(workers) as executor:
        yield executor
