"""Jobs of the workers under test, which import only this module."""

from __future__ import annotations

import os
import signal
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from multiprocessing.connection import Connection
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from airl_mav.core.errors import UsageError
from airl_mav.experiments.executors import ProcessExecutor, Stop

if TYPE_CHECKING:  # a second of imports in every worker
    from airl_mav.experiments.executors import FlyEpisodes
    from airl_mav.rehearsal.run_folder import FlownEpisode, RunFolder
    from airl_mav.scenario.resolve import PlannedEpisode

PATIENCE_S = 60.0


def wait_for(condition: Callable[[], Any]) -> None:
    """Wait until the condition is true."""
    deadline = time.monotonic() + PATIENCE_S
    while not condition():
        if time.monotonic() > deadline:
            raise TimeoutError("waited in vain")
        time.sleep(0.01)


def doubles(stop: Stop) -> Callable[[int], list[tuple[int, int]]]:
    """Return twice each job, with the worker's process id."""
    return lambda job: [(2 * job, os.getpid())]


def pairs(stop: Stop) -> Callable[[int], Iterator[int]]:
    """Each job gives two results."""
    return lambda job: iter((job, -job))


def compiles(stop: Stop) -> Callable[[int], list[int]]:
    """Each job compiles a kernel."""
    import numba

    import airl_mav.core.kernels  # noqa: F401 (what reports it)

    return lambda job: [numba.njit(lambda x: x + job)(1)]


def counted(folder: Path, stop: Stop) -> Callable[[int], list[int]]:
    """Leave a file with each start and each job."""
    (folder / f"start-{os.getpid()}").touch(exist_ok=False)

    def work(job: int) -> list[int]:
        (folder / f"job-{job}").touch(exist_ok=False)
        return [job]

    return work


def all_but_the_first(folder: Path, jobs: int, stop: Stop) -> Callable[[int], list[int]]:
    """Job 0 ends when all others have."""

    def work(job: int) -> list[int]:
        if job == 0:
            wait_for(lambda: len(list(folder.iterdir())) == jobs - 1)
        else:
            (folder / f"{job}").touch()
        return [job]

    return work


def surroundings(stop: Stop) -> Callable[[int], list[dict[str, Any]]]:
    """Return a job that reports the process's environment."""

    def work(_: int) -> list[dict[str, Any]]:
        blocked = signal.pthread_sigmask(signal.SIG_BLOCK, set())
        surroundings = {
            "threads": {k: v for k, v in os.environ.items() if k.endswith("_NUM_THREADS")},
            "deaf": signal.SIGINT in blocked,
        }
        return [surroundings]

    return work


def dies(folder: Path, times: int, how: str, stop: Stop) -> Callable[[int], list[int]]:
    """Return a job that ends its worker at job 3, `times` times."""

    def work(job: int) -> list[int]:
        if job == 3 and (before := len(list(folder.iterdir()))) < times:
            (folder / f"{before}").touch(exist_ok=False)
            _die(how)
        return [job]

    return work


def _die(how: str) -> None:
    if how == "kill":
        os.kill(os.getpid(), signal.SIGKILL)
    elif how == "exit":
        os._exit(7)
    else:

        def half(connection: Connection, data: Any, *_: Any) -> NoReturn:
            os.write(connection.fileno(), bytes(data)[:3])
            os._exit(7)

        Connection._send = half  # type: ignore[attr-defined]  # private, not in the stubs


def complains(how: str, stop: Stop) -> Callable[[int], list[int]]:
    """Job 3, or the start, cannot be done."""
    if how == "start":
        raise UsageError("nothing to start with")

    def work(job: int) -> list[int]:
        if job == 3 and how == "usage":
            raise UsageError("three is too many")
        if job == 3:
            raise RuntimeError("three\nlines of\ntrouble")
        return [job]

    return work


def sleeps(folder: Path, stop: Stop) -> Callable[[int], list[int]]:
    """Jobs from 2 on never end; each leaves its process's number."""

    def work(job: int) -> list[int]:
        if job >= 2:
            partial = folder / f".{job}"
            partial.write_text(f"{os.getpid()}")
            partial.rename(folder / f"pid-{job}")
            time.sleep(3600)
        return [job]

    return work


class PaperFlier:
    """Flies by copying what was flown. Implements `campaign.Flier`."""

    def __init__(self, episodes: dict[int, FlownEpisode], deadly: int, per_job: int = 1) -> None:
        self.episodes, self.deadly, self.per_job = episodes, deadly, per_job

    def episodes_per_job(self, episodes: int, workers: int) -> int:
        """Return the configured number."""
        return self.per_job

    def start(self, folder: RunFolder, stop: Stop) -> FlyEpisodes:
        """Load nothing."""

        def fly(episodes: Sequence[PlannedEpisode]) -> Iterator[FlownEpisode]:
            for episode in episodes:
                if episode.seed == self.deadly:
                    os.kill(os.getpid(), signal.SIGKILL)
                yield self.episodes[episode.index]

        return fly


if __name__ == "__main__":
    # Workers do not see the program that started them, only what can be imported.
    from tests.support import worker_jobs

    with ProcessExecutor(2) as executor:
        list(executor.run(range(4), partial(worker_jobs.sleeps, Path(sys.argv[1]))))
