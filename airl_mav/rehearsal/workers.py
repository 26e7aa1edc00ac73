"""Worker processes: each takes one job after the other, and a lost one is replaced.

Nothing is shared but one pipe a worker, so that a worker that is killed, even half-way through an
answer, cannot hold up the others. Workers are new processes ("spawn"), never forks: threads of
MAVSDK and of ONNX Runtime do not survive one. A worker ends with its parent, however that ends.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from types import TracebackType
from typing import Any, Generic, TypeVar

from airl_mav.core.errors import UsageError

J = TypeVar("J")
R = TypeVar("R")

GREATEST_WORKERS = 256

TRIES = 3
"""A job whose worker is lost is given to so many, the first included."""

LOOK_S = 0.2
"""How often somebody who wants to stop is asked [wall s]."""

END_S = 5.0
"""A worker without work ends by itself in so long, or is killed [wall s]."""

ONE_THREAD = dict.fromkeys(
    ("MKL_NUM_THREADS", "NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1"
)
"""Environment of a worker: one core is all that it has."""


class WorkerError(Exception):
    """A job cannot be done; the message names it and says why."""


@dataclass(frozen=True)
class _Failed:
    """A worker's answer when a job could not be done."""

    message: str
    usage: bool
    """The input cannot be used: an error of whoever asked."""


@dataclass
class _Worker(Generic[J]):
    """A worker as its parent sees it."""

    process: BaseProcess
    job: J
    """What it does now."""


class Workers(Generic[J, R]):
    """Processes that do jobs. Use as a context manager: whatever happens, all of them end."""

    def __init__(
        self,
        start: Callable[[], Callable[[J], R]],
        count: int,
        *,
        name: Callable[[J], str] = str,
        lost: Callable[[str], None] = lambda _: None,
    ) -> None:
        """Say what they do; none is started before there are jobs.

        Args:
            start: Called once in each worker; returns what does a job. Goes there by pickle.
            count: Greatest number of workers at a time.
            name: What a job is called in messages.
            lost: Is told, in words, of each worker that was lost.
        """
        self._start = start
        self._count = count
        self._name = name
        self._lost = lost
        self._busy: dict[Connection, _Worker[J]] = {}
        self._ending: list[BaseProcess] = []
        """They have no work left."""

    def __enter__(self) -> Workers[J, R]:
        """Return the workers."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """End all of them: those at work at once."""
        for connection, worker in self._busy.items():
            worker.process.kill()
            connection.close()
            self._ending.append(worker.process)
        self._busy.clear()
        for process in self._ending:
            process.join(END_S)
            if process.exitcode is None:
                process.kill()
                process.join()
            process.close()
        self._ending.clear()

    def do(self, jobs: Sequence[J], stop: Callable[[], bool] = lambda: False) -> Iterator[R]:
        """Do the jobs, each by whoever is free, and yield results as they come, in any order.

        Args:
            jobs: What is to be done.
            stop: Asked several times a second; True ends it all, jobs at work are given up.

        Raises:
            UsageError: A worker said so.
            WorkerError: A job failed, or its worker was lost `TRIES` times.
        """
        waiting = deque(jobs)
        tries: Counter[J] = Counter()
        while waiting and len(self._busy) < self._count and not stop():
            self._hire(waiting.popleft())
        while self._busy:
            for connection in wait(list(self._busy), LOOK_S):
                assert isinstance(connection, Connection)  # noqa: S101 (as they went in)
                worker = self._busy[connection]
                try:
                    answer = connection.recv()
                except (EOFError, OSError):
                    self._replace(connection, tries)
                    continue
                if isinstance(answer, _Failed):
                    kind = UsageError if answer.usage else WorkerError
                    raise kind(f"{self._name(worker.job)}: {answer.message}")
                # First of all: nobody waits for what is done with a result.
                self._give(connection, waiting)
                yield answer
            if stop():
                return

    def _hire(self, job: J) -> None:
        """Start a worker with its first job."""
        ours, process = _spawn(self._start)
        self._busy[ours] = _Worker(process, job)
        self._send(ours, job)

    def _give(self, connection: Connection, waiting: deque[J]) -> None:
        """Give a worker its next job, or let it go."""
        worker = self._busy[connection]
        if waiting:
            worker.job = waiting.popleft()
            self._send(connection, worker.job)
        else:
            del self._busy[connection]
            connection.close()
            self._ending.append(worker.process)

    def _send(self, connection: Connection, job: J) -> None:
        # A worker that is lost shows when its answer is looked for.
        with suppress(OSError):
            connection.send(job)

    def _replace(self, connection: Connection, tries: Counter[J]) -> None:
        """Give the job of a lost worker to a new one."""
        worker = self._busy.pop(connection)
        connection.close()
        worker.process.kill()
        worker.process.join()
        how = _how_it_ended(worker.process.exitcode)
        worker.process.close()
        job = worker.job
        tries[job] += 1
        if tries[job] == TRIES:
            raise WorkerError(f"{self._name(job)}: lost {TRIES} workers, the last one by {how}")
        self._lost(f"a worker was lost by {how}: {self._name(job)} begins again")
        self._hire(job)


def _spawn(start: Callable[[], Callable[[Any], Any]]) -> tuple[Connection, BaseProcess]:
    """Start a worker; return the parent's end of its pipe, and the process."""
    context = multiprocessing.get_context("spawn")
    # Would be started with the first worker otherwise, and let Ctrl-C through again.
    resource_tracker.ensure_running()
    ours, theirs = context.Pipe()
    process = context.Process(target=_serve, args=(theirs, start), daemon=True)
    with ExitStack() as stack:
        stack.enter_context(theirs)
        stack.enter_context(_environment(ONE_THREAD))
        stack.enter_context(_interrupts_blocked())
        process.start()
    return ours, process


@contextmanager
def _environment(values: dict[str, str]) -> Iterator[None]:
    """Set environment variables for a while: a new process reads them before it runs anything."""
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
    """Block Ctrl-C for a while: a process started meanwhile is deaf to it from its first moment.

    A terminal sends it to all processes, and what becomes of the workers is their parent's say.
    """
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _how_it_ended(exitcode: int | None) -> str:
    if exitcode is not None and exitcode < 0:
        with suppress(ValueError):
            return signal.Signals(-exitcode).name
    return f"exit status {exitcode}"


# --- in the worker


def _serve(connection: Connection, start: Callable[[], Callable[[Any], Any]]) -> None:
    """Do jobs until the pipe is closed."""
    _end_with_parent()
    work: Callable[[Any], Any] | None = None
    while True:
        try:
            job = connection.recv()
        except EOFError:
            return
        try:
            work = work or start()
            answer = work(job)
        except UsageError as error:
            answer = _Failed(str(error), usage=True)
        except Exception as error:
            answer = _Failed(_in_a_line(error), usage=False)
        try:
            connection.send(answer)
        except OSError:  # The parent has gone.
            return


def _end_with_parent() -> None:
    """End this process as soon as its parent is gone, in the middle of anything."""
    parent = multiprocessing.parent_process()
    assert parent is not None  # noqa: S101 (this is a worker)

    def watch() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=watch, name="parent-watch", daemon=True).start()


def _in_a_line(error: Exception) -> str:
    text = f"{type(error).__name__}: {error}" if str(error) else type(error).__name__
    return " ".join(text.split())
