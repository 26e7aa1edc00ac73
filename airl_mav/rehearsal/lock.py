"""Lock that reserves a folder for one run and all its processes."""

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
"""Maximum wait for the processes of a killed run to end [wall s]."""

POLL_S = 0.05
"""Time between two attempts to take the lock [wall s]."""


@contextmanager
def locked(path: Path, say: Callable[[str], None]) -> Iterator[int]:
    """Create a folder if needed, and lock it for this process and processes that inherit the lock.

    The lock ends with the last process that has the yielded descriptor. Waits for the processes of
    a killed run, which hold its ports and may still write.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
        # Locks the folder: a lock file would need cleanup.
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
        # Some file systems, mainly network ones, do not support locks. Nothing then prevents two
        # runs in one folder.
        return True
    return True
