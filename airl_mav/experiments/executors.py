"""Executors of jobs: this process, worker processes or a Ray cluster, with equal results."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable, Sequence
from dataclasses import dataclass
from typing import ClassVar, Protocol, TypeVar

from airl_mav.core.compiling import Heard, heard_compiling
from airl_mav.core.constants import MAX_ATTEMPTS
from airl_mav.core.errors import UsageError
from airl_mav.core.fields import quantity
from airl_mav.rehearsal.run_folder import FlownEpisode, RunFolder
from airl_mav.scenario.model import Workers
from airl_mav.scenario.resolved import PlannedEpisode

J = TypeVar("J")
R = TypeVar("R")

Stop = Callable[[], bool]
"""Asked again and again; True ends the work."""

Work = Callable[[J], Iterable[R]]
"""Carries out a job: gives its results, of which there may be several."""

Start = Callable[[Stop], Work[J, R]]
"""Called once in each worker, to load everything. Goes there by pickle. It is given what asks
whether the work is to be stopped, for work in this process. Other workers are ended instead."""

Results = Generator[tuple[J, R], None, None]
"""Results as they come, each with its job. Closing it ends the workers, whatever they do."""

POLL_S = 0.2
"""Interval at which `stop` is asked while results are awaited [wall s]."""

ONE_THREAD = dict.fromkeys(
    ("MKL_NUM_THREADS", "NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1"
)
"""Environment of a worker: it has one core."""


class WorkerError(Exception):
    """A job cannot be carried out; the message names it and the reason."""


def never() -> bool:
    """Return False: nobody wants to stop."""
    return False


class Executor(Protocol):
    """Carries out jobs, several at a time."""

    @property
    def workers(self) -> int:
        """Number of jobs at a time."""

    @property
    def streams(self) -> bool:
        """Whether results are yielded while their job goes on, not at its end."""

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

        `start` initializes a worker; `stop` is polled several times a second and aborts the running
        jobs; `lost` is told in one line of each lost worker, whose job restarts without partial
        results; `compiling` is called when local workers begin and end compiling kernels.

        Raises:
            UsageError: A job rejects its input.
            WorkerError: A job failed, or its worker was lost `MAX_ATTEMPTS` times.
        """


class InProcessExecutor:
    """This process, job by job; results are streamed and errors raised as they are."""

    workers: ClassVar[int] = 1
    streams: ClassVar[bool] = True

    def run(
        self,
        jobs: Iterable[J],
        start: Start[J, R],
        *,
        name: Callable[[J], str] = str,
        stop: Stop = never,
        lost: Callable[[str], None] = lambda _: None,  # noqa: ARG002 (nobody is lost here)
        compiling: Heard = lambda _: None,
    ) -> Results[J, R]:
        """Carry out jobs; see `Executor`."""
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


class ExecutorSettings(Workers):
    """Who carries out the jobs of an experiment, and what a job takes."""

    ray_gpus: float = quantity("share of a GPU for each job", "1", ge=0.0, le=8.0, default=0.0)


# --- what the executors with workers have in common


@dataclass(frozen=True)
class Failure:
    """A worker's answer when a job could not be carried out."""

    message: str
    usage: bool

    def error(self, job: str) -> UsageError | WorkerError:
        """Return what is raised for a job of that name."""
        return (UsageError if self.usage else WorkerError)(f"{job}: {self.message}")


def answer(work: Callable[[], Iterable[R]]) -> list[R] | Failure:
    """Return a worker's answer: all results of a job, or why there are none."""
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


FlyEpisodes = Callable[[Sequence[PlannedEpisode]], Iterable[FlownEpisode]]


class Flier(Protocol):
    """How the episodes of a scenario are flown. Goes to workers by pickle."""

    def episodes_per_job(self, episodes: int, workers: int) -> int:
        """Return the episodes per job for executors that do not stream results."""

    def start(self, folder: RunFolder, stop: Stop) -> FlyEpisodes:
        """Load everything once; return a function that flies episodes and polls `stop`."""
