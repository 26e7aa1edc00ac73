"""A folder that belongs to one run at a time, and to all processes of it."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from airl_mav.core.clock import WallClock
from airl_mav.core.constants import US_PER_S
from airl_mav.core.errors import UsageError

WAIT_S = 20.0
"""How long the processes of a run that was killed may take to end [wall s]."""

POLL_S = 0.05
"""Time between two attempts to take the lock [wall s]."""


@contextmanager
def locked(path: Path, say: Callable[[str], None]) -> Iterator[int]:
    """Keep a folder, made when there is none, to this process and those that inherit the lock.

    The lock ends with the last process that has the yielded descriptor. The processes of a killed
    run are waited for. They hold its ports and may still write.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
        # The folder itself: a file of its own would have to be cleaned up.
        descriptor = os.open(path, os.O_RDONLY)
    except OSError as error:
        raise UsageError(f"--out {path}: {error.strerror}") from None
    try:
        _acquire(descriptor, path, say)
        yield descriptor
    finally:
        os.close(descriptor)


def _acquire(descriptor: int, path: Path, say: Callable[[str], None]) -> None:
    if _try(descriptor):
        return
    say(f"{path}: waiting for the processes of an earlier run to end")
    clock = WallClock()
    while not _try(descriptor):
        now_us = clock.time_us()
        if now_us > WAIT_S * US_PER_S:
            raise UsageError(f"--out {path}: another run flies into it; accepted: a new folder")
        clock.sleep_until(now_us + int(POLL_S * US_PER_S))


def _try(descriptor: int) -> bool:
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:
        # Some file systems, above all those of a network, have no such locks. Then nothing keeps
        # two runs out of one folder.
        return True
    return True
