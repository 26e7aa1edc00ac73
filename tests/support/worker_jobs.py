"""What the workers under test do; they import this module by itself."""

from __future__ import annotations

import os
import signal
import sys
import time
from collections.abc import Callable
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, NoReturn

from airl_mav.core.errors import UsageError
from airl_mav.rehearsal.evaluation import Job
from airl_mav.rehearsal.evaluation_lockstep import Fly
from airl_mav.rehearsal.run_folder import FlownEpisode, RunFolder
from airl_mav.rehearsal.workers import Workers

PATIENCE_S = 60.0


def wait_for(condition: Callable[[], Any]) -> None:
    """Wait until the condition is true."""
    deadline = time.monotonic() + PATIENCE_S
    while not condition():
        if time.monotonic() > deadline:
            raise TimeoutError("waited in vain")
        time.sleep(0.01)


def doubles() -> Callable[[int], tuple[int, int]]:
    """Each job gives its double, and who did it."""
    return lambda job: (2 * job, os.getpid())


def counted(folder: Path) -> Callable[[int], int]:
    """Leave a file with each start and each job."""
    (folder / f"start-{os.getpid()}").touch(exist_ok=False)

    def work(job: int) -> int:
        (folder / f"job-{job}").touch(exist_ok=False)
        return job

    return work


def all_but_the_first(folder: Path, jobs: int) -> Callable[[int], int]:
    """Job 0 ends when all others have."""

    def work(job: int) -> int:
        if job == 0:
            wait_for(lambda: len(list(folder.iterdir())) == jobs - 1)
        else:
            (folder / f"{job}").touch()
        return job

    return work


def surroundings() -> Callable[[int], dict[str, Any]]:
    """Tell of the process."""

    def work(_: int) -> dict[str, Any]:
        blocked = signal.pthread_sigmask(signal.SIG_BLOCK, set())
        return {
            "threads": {k: v for k, v in os.environ.items() if k.endswith("_NUM_THREADS")},
            "deaf": signal.SIGINT in blocked,
        }

    return work


def dies(folder: Path, times: int, how: str) -> Callable[[int], int]:
    """Job 3 ends its worker so many times."""

    def work(job: int) -> int:
        if job == 3 and (before := len(list(folder.iterdir()))) < times:
            (folder / f"{before}").touch(exist_ok=False)
            _die(how)
        return job

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

        Connection._send = half  # type: ignore[attr-defined]


def complains(how: str) -> Callable[[int], int]:
    """Job 3, or the start, cannot be done."""
    if how == "start":
        raise UsageError("nothing to start with")

    def work(job: int) -> int:
        if job == 3 and how == "usage":
            raise UsageError("three is too many")
        if job == 3:
            raise RuntimeError("three\nlines of\ntrouble")
        return job

    return work


def sleeps(folder: Path) -> Callable[[int], int]:
    """Jobs from 2 on never end; each leaves its process's number."""

    def work(job: int) -> int:
        if job >= 2:
            partial = folder / f".{job}"
            partial.write_text(f"{os.getpid()}")
            partial.rename(folder / f"pid-{job}")
            time.sleep(3600)
        return job

    return work


class Sleeper:
    """`sleeps` for a command line."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def __call__(self) -> Callable[[int], int]:
        """Start."""
        return sleeps(self.folder)


class PaperFlier:
    """Flies by copying what was flown. Implements `evaluation_lockstep.Flier`."""

    def __init__(self, episodes: dict[int, FlownEpisode], deadly: int) -> None:
        self.episodes, self.deadly = episodes, deadly

    def start(self, tlogs: RunFolder | None) -> Fly:
        """Load nothing."""

        def fly(job: Job) -> FlownEpisode:
            if job.seed == self.deadly:
                os.kill(os.getpid(), signal.SIGKILL)
            return self.episodes[job.index]

        return fly


if __name__ == "__main__":
    with Workers(Sleeper(Path(sys.argv[1])), 2) as workers:
        for _ in workers.do(range(4)):
            pass
