"""pybullet, imported and connected without its banner.

A BulletClient looks up and wraps every function at every call, which costs more than most of the
functions: code that runs at every tick calls `pybullet` itself with the client's number.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import sys
from collections.abc import Iterator
from typing import Any


@contextlib.contextmanager
def silenced_output() -> Iterator[None]:
    """Point standard output and standard error at the null device for a while: for C libraries."""
    sys.stdout.flush()
    sys.stderr.flush()
    kept = [(number, os.dup(number)) for number in (1, 2)]
    null = os.open(os.devnull, os.O_WRONLY)
    try:
        for number, _ in kept:
            os.dup2(null, number)
        yield
        # What C has buffered meanwhile must go the same way, not out at exit.
        ctypes.CDLL(None).fflush(None)
    finally:
        for number, copy in kept:
            os.dup2(copy, number)
            os.close(copy)
        os.close(null)


# It prints banners from C, at import and when a client connects.
with silenced_output():
    import pybullet
    from pybullet_utils.bullet_client import BulletClient

__all__ = ["NO_CLIENT", "connect", "number_of", "pybullet"]

NO_CLIENT = -1
"""Number of a client that has been closed: every call with it raises pybullet.error."""


def connect() -> Any:
    """Return a client of a new physics server in this process."""
    with silenced_output():
        return BulletClient(pybullet.DIRECT)


def number_of(client: Any) -> int:
    """Return the `physicsClientId` of a client."""
    return int(client._client)
