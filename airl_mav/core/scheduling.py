"""How the host schedules this process."""

from __future__ import annotations

import ctypes
import os
import platform
import sys
from contextlib import suppress
from pathlib import Path

SLICE_NS = 100_000
"""Linux' shortest time slice [ns]."""

_SCHED_SETATTR = {"x86_64": 314, "aarch64": 274}
"""Number of the system call sched_setattr (Linux, unistd.h)."""


class _Attributes(ctypes.Structure):
    """struct sched_attr, as of sched_setattr(2)."""

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
    """Ask that this thread, and what it starts from now on, run soon when they are woken.

    Threads that hand work to and fro all the time wait for their turn each time. With short slices
    they have it sooner, and no more of the processor than before. Linux knows this from 6.12 on
    (EEVDF: the slice of a thread is its request); elsewhere nothing happens.
    """
    _ask_for_slices(SLICE_NS)


def _ask_for_slices(length_ns: int) -> None:
    """Ask for slices of a length [ns], 0: as Linux has them for all."""
    number = _SCHED_SETATTR.get(platform.machine())
    if sys.platform != "linux" or number is None or os.sched_getscheduler(0) != os.SCHED_OTHER:
        return
    nice = os.getpriority(os.PRIO_PROCESS, 0)
    asked = _Attributes(ctypes.sizeof(_Attributes), 0, 0, nice, 0, length_ns, 0, 0)
    # Refused or not known: nothing depends on it.
    ctypes.CDLL(None).syscall(number, 0, ctypes.byref(asked), 0)


def give_way(niceness: int) -> None:
    """Let all others run before this process and what it starts from now on; niceness 1 to 19.

    Linux' autogroups share the processor out among sessions. Niceness counts only within one: a
    nice process of one session takes half of what an urgent one of another could have. So this
    process becomes a session of its own, and is nice as such, too (sched(7)). Short slices of its
    parent are no longer its own.
    """
    os.nice(niceness)
    _ask_for_slices(0)
    with suppress(OSError):  # It leads its process group already, and perhaps its session.
        os.setsid()
    if os.getsid(0) == os.getpid():
        with suppress(OSError):  # There are no autogroups here.
            Path("/proc/self/autogroup").write_text(str(niceness), "ascii")
