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
from airl_mav.scenario.resolve import PlannedEpisode

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


class ExecutorSettings(Workers):
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


FlyEpisodes = Callable[[Sequence[PlannedEpisode]], Iterable[FlownEpisode]]


class Flier(Protocol):
    """Interface to fly the episodes of a scenario. Sent to workers by pickle."""

    def episodes_per_job(self, episodes: int, workers: int) -> int:
        """Return the episodes per job for executors that do not stream results."""

    def start(self, folder: RunFolder, stop: Stop) -> FlyEpisodes:
        """Load everything once; return a function that flies episodes and polls `stop`."""
