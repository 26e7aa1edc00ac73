"""Executor with worker processes on this machine: each runs job after job; lost ones are replaced.

Each worker has a separate pipe, so a killed worker cannot block the others. Workers are spawned,
never forked: threads of MAVSDK and ONNX Runtime do not survive a fork. A worker ends with its
parent.
"""

from __future__ import annotations

import importlib
import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from types import ModuleType
from typing import Any, ClassVar, Generic, NamedTuple

from airl_mav.core.addons import addon_executors
from airl_mav.core.compiling import Heard, heard_compiling
from airl_mav.core.errors import FieldError
from airl_mav.core.machine import usable_cores
from airl_mav.experiments import executors
from airl_mav.scenario.aircraft import GREATEST_INSTANCE, Aircraft
from airl_mav.scenario.model import GREATEST_WORKERS, Workers

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
        jobs: Iterable[executors.J],
        start: executors.Start[executors.J, executors.R],
        *,
        name: Callable[[executors.J], str] = str,
        stop: executors.Stop = executors.never,
        lost: Callable[[str], None] = lambda _: None,
        compiling: Heard = lambda _: None,
    ) -> executors.Results[executors.J, executors.R]:
        """Run jobs; see `executors.Executor`. Closing the generator ends only busy workers."""
        waiting = iter(jobs)
        pool: _Pool[executors.J] = _Pool(start, self._idle)
        try:
            while len(pool.busy) < self.workers and not stop():
                try:
                    pool.hire(next(waiting))
                except StopIteration:
                    break
            while pool.busy:
                for connection in wait(list(pool.busy), executors.POLL_S):
                    assert isinstance(connection, Connection)  # noqa: S101 (as they went in)
                    worker = pool.busy[connection]
                    job = worker.job
                    try:
                        told = connection.recv()
                    except (EOFError, OSError):
                        cause = pool.bury(connection)
                        pool.hire(
                            job, executors.next_attempt(name(job), worker.attempt, cause, lost)
                        )
                        continue
                    if isinstance(told, _Compiling):
                        worker.compiles = told.begins
                        compiling(any(each.compiles for each in pool.busy.values()))
                        continue
                    if isinstance(told, executors.Failure):
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
class _Worker(Generic[executors.J]):
    """State of a busy worker in the parent."""

    process: BaseProcess
    job: executors.J
    attempt: int
    """Number of workers that have received this job."""
    compiles: bool = False


class _Pool(Generic[executors.J]):
    """Worker processes of one run."""

    def __init__(self, start: executors.Start[executors.J, Any], idle: list[_Idle]) -> None:
        self._start = start
        self.busy: dict[Connection, _Worker[executors.J]] = {}
        self._idle = idle
        """Idle workers, used before new ones are started."""

    def hire(self, job: executors.J, attempt: int = 1) -> None:
        """Assign a worker to this run and send its first job."""
        worker = self._take_idle() or _spawn()
        self.busy[worker.connection] = _Worker(worker.process, job, attempt)
        _send(worker.connection, (self._start, job))

    def _take_idle(self) -> _Idle | None:
        """Return an idle worker and remove lost ones; None if there is no idle worker."""
        while self._idle:
            worker = self._idle.pop()
            if worker.process.is_alive():
                return worker
            worker.connection.close()
            _remove(worker.process)
        return None

    def give(self, connection: Connection, waiting: Iterator[executors.J]) -> None:
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
        stack.enter_context(_environment(executors.ONE_THREAD))
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
    start: executors.Start[Any, Any] | None = None
    work: executors.Work[Any, Any] | None = None

    def carry_out(job: Any) -> Iterable[Any]:
        nonlocal start, work
        if start is not None:
            work = None  # Release the previous run's data first.
            work, start = start(executors.never), None
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
        start = new or start
        with heard_compiling(tell):
            told = executors.answer(partial(carry_out, job))
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


def side_by_side(settings: Workers) -> int:
    """Return the maximum of parallel flights; the user starts PX4's instances."""
    if not isinstance(settings, Aircraft) or settings.firmware == "builtin":
        return GREATEST_WORKERS
    real = settings.real
    return 1 if real.px4_dir is None else GREATEST_INSTANCE + 1 - real.instance


@contextmanager
def open_executor(settings: Workers, *, in_process: bool = False) -> Iterator[executors.Executor]:
    """Open the configured executor; a single worker may be this process if `in_process`."""
    cores = min(usable_cores(), GREATEST_WORKERS)
    if settings.executor != "process":
        known = addon_executors()
        if settings.executor not in known:
            raise FieldError("executor", settings.executor, ", ".join(("process", *known)))
        gpus = settings.ray_gpus if isinstance(settings, executors.ExecutorSettings) else 0.0
        module = importlib.import_module(known[settings.executor])
        with module.connected(settings, cores, gpus) as executor:
            yield executor
        return
    most = side_by_side(settings)
    if settings.workers is not None and settings.workers > most:
        raise FieldError("workers", settings.workers, f"1 <= value <= {most} with this firmware")
    workers = settings.workers or (1 if in_process else min(cores, most))
    if in_process and workers == 1:
        yield executors.InProcessExecutor()
        return
    with ProcessExecutor(workers) as executor:
        yield executor
