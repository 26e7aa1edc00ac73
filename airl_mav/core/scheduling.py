"""Host scheduling of this process: time slices and niceness (Linux)."""

from __future__ import annotations

import ctypes
import os
import platform
import sys
from contextlib import suppress
from pathlib import Path

SLICE_NS = 100_000
"""Minimum time slice of Linux [ns]."""

_SCHED_SETATTR = {"x86_64": 314, "aarch64": 274}
"""Number of the system call sched_setattr (Linux, unistd.h)."""


class _Attributes(ctypes.Structure):
    """Structure sched_attr, as in sched_setattr(2)."""

    _fields_ = (
        ("size", ctypes.c_uint32),
        ("policy", ctypes.c_uint32),
        ("flags", ctypes.c_uint64),
        ("nice", ctypes.c_int32),
        ("priority", ctypes.c_uint32),
        ("runtime", ctypes.c_uint64),
        ("deadline", ctypes.c_uint64),
        ("period", ctypes.c_uint64),
    )


def ask_for_short_slices() -> None:
    """Request short time slices for this thread and its later children, for faster wake-up.

    Threads that continuously hand work to each other wait for the processor each time. Short slices
    shorten these waits at the same processor share. Supported by Linux 6.12 and later (EEVDF: the
    slice of a thread is its request); otherwise without effect.
    """
    _ask_for_slices(SLICE_NS)


def _ask_for_slices(length_ns: int) -> None:
    """Request slices of a length [ns]; 0 = Linux's default."""
    number = _SCHED_SETATTR.get(platform.machine())
    if sys.platform != "linux" or number is None or os.sched_getscheduler(0) != os.SCHED_OTHER:
        return
    nice = os.getpriority(os.PRIO_PROCESS, 0)
    asked = _Attributes(ctypes.sizeof(_Attributes), 0, 0, nice, 0, length_ns, 0, 0)
    # Optional: failures are ignored.
    ctypes.CDLL(None).syscall(number, 0, ctypes.byref(asked), 0)


def give_way(niceness: int) -> None:
    """Lower the priority of this process and its later children; niceness 1 to 19.

    Linux's autogroups divide the processor among sessions, and niceness counts only within a
    session. A nice process would take half of the time that an urgent process of another session
    needs. Therefore this process starts a new session with its own autogroup niceness (sched(7)).
    The parent's short slices are reset.
    """
    os.nice(niceness)
    _ask_for_slices(0)
    with suppress(OSError):  # Already a process group leader, or a session leader.
        os.setsid()
    if os.getsid(0) == os.getpid():
        with suppress(OSError):  # Autogroups are not available.
            Path("/proc/self/autogroup").write_text(str(niceness), "ascii")
