"""Host scheduling of this process: time slices, niceness, and a limit of processor time (Linux).

The limit is a separate control group. The kernel lets the group run for its quota in every period
and stops all its threads for the rest (Documentation/scheduler/sched-bwc.rst). Version 2 has
`cpu.max`, version 1 `cpu.cfs_quota_us`.
"""

from __future__ import annotations

import ctypes
import os
import platform
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from airl_mav.core.errors import UsageError

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


LEAST_QUOTA_US = 1_000
"""Minimum quota of the kernel [µs]. It gives the shortest period for shares of less than a core, so
a decision is slowed evenly instead of stopped once for long. A decision that takes less than the
quota is not slowed."""

PERIOD_US = 10_000
"""Period for a core or more [µs]."""

PREFIX = "airl-quota-"
OPTION = "--cpu-quota"


@dataclass(frozen=True)
class CpuGroup:
    """Control group that limits its processes to a share of a core."""

    path: Path
    version: int
    """Version of the control groups: 1 or 2."""

    def set_quota(self, percent: float) -> None:
        """Set the quota [% of one core]. Raises OSError."""
        if percent < 100.0:
            quota_us, period_us = LEAST_QUOTA_US, round(LEAST_QUOTA_US * 100.0 / percent)
        else:
            quota_us, period_us = round(PERIOD_US * percent / 100.0), PERIOD_US
        if self.version == 2:
            (self.path / "cpu.max").write_text(f"{quota_us} {period_us}")
        else:
            (self.path / "cpu.cfs_period_us").write_text(f"{period_us}")
            (self.path / "cpu.cfs_quota_us").write_text(f"{quota_us}")

    def statistics(self) -> dict[str, int]:
        """Return the kernel's `cpu.stat`: nr_periods, nr_throttled and more."""
        lines = (self.path / "cpu.stat").read_text().splitlines()
        return {key: int(value) for key, _, value in (line.partition(" ") for line in lines)}


@dataclass(frozen=True)
class _Home:
    """Control group of this process, and possible parents of a new group."""

    version: int
    own: Path
    parents: tuple[Path, ...]


@contextmanager
def held_to(percent: float | None, root: Path = Path("/")) -> Iterator[CpuGroup | None]:
    """Limit this process, with its threads and future children, to a share of a core [%].

    None = no limit; `root` contains /proc and /sys. Raises UsageError if the system forbids it.
    """
    if percent is None:
        yield None
        return
    home = _home(root)
    group = _made(home, percent)
    try:
        _move(group.path)
    except OSError as error:
        group.path.rmdir()
        raise _refused(f"this process cannot be moved to {group.path}: {error.strerror}") from None
    try:
        yield group
    finally:
        # A group with a process in it cannot be removed.
        with suppress(OSError):
            _move(home.own)
            group.path.rmdir()


def check_permitted(percent: float | None, root: Path = Path("/")) -> None:
    """Raise UsageError, with the reason, unless this process can be limited to the share."""
    if percent is not None:
        _made(_home(root), percent).path.rmdir()


def remove_left(root: Path = Path("/")) -> None:
    """Remove the groups of killed processes."""
    with suppress(UsageError):
        for parent in _home(root).parents:
            _sweep(parent)


def _made(home: _Home, percent: float) -> CpuGroup:
    """Create a group with a quota. Raises UsageError."""
    reason = ""
    for parent in home.parents:
        _sweep(parent)
        path = parent / f"{PREFIX}{os.getpid()}"
        try:
            path.mkdir()
        except OSError as error:
            reason = f"no group can be made in {parent}: {error.strerror}"
            continue
        group = CpuGroup(path, home.version)
        try:
            if home.version == 2 and not (path / "cpu.max").exists():
                (parent / "cgroup.subtree_control").write_text("+cpu")
            group.set_quota(percent)
        except OSError as error:
            path.rmdir()
            reason = f"the CPU controller cannot be used in {parent}: {error.strerror}"
            continue
        return group
    raise _refused(reason)


def _home(root: Path) -> _Home:
    """Find the CPU controller. Raises UsageError."""
    try:
        memberships = (root / "proc/self/cgroup").read_text().splitlines()
        mounts = [line.split() for line in (root / "proc/self/mounts").read_text().splitlines()]
    except OSError:
        raise _refused("no control groups: Linux has them") from None
    groups = [line.split(":", 2) for line in memberships]
    for _, controllers, own in groups:
        if "cpu" in controllers.split(","):
            for _, point, kind, options, *_ in mounts:
                if kind == "cgroup" and "cpu" in options.split(","):
                    place = _inside(root, point, own)
                    return _Home(1, place, (place,))
    for number, controllers, own in groups:
        if number == "0" and not controllers:
            for _, point, kind, *_ in mounts:
                place = _inside(root, point, own)
                if kind == "cgroup2" and "cpu" in _words(place / "cgroup.controllers"):
                    # Except for the root, a group with processes cannot have child groups with
                    # controllers: use a sibling group.
                    beside = (place.parent,) if own != "/" else ()
                    return _Home(2, place, (*beside, place))
    raise _refused("the CPU controller of control groups is not there")


def _inside(root: Path, point: str, own: str) -> Path:
    """Return a process's group in a mounted hierarchy."""
    place = root / point.lstrip("/")
    inner = place / own.lstrip("/")
    # Inside a container the path may be the host's.
    return inner if inner.is_dir() else place


def _sweep(parent: Path) -> None:
    """Remove the groups of processes that have ended."""
    for old in parent.glob(f"{PREFIX}*"):
        # A living process may be about to move into its group. The kernel keeps groups with
        # processes.
        if not Path(f"/proc/{old.name.removeprefix(PREFIX)}").exists():
            with suppress(OSError):
                old.rmdir()


def _move(group: Path) -> None:
    """Move this process with all its threads. Raises OSError."""
    (group / "cgroup.procs").write_text(f"{os.getpid()}")


def _words(path: Path) -> list[str]:
    try:
        return path.read_text().split()
    except OSError:
        return []


def _refused(reason: str) -> UsageError:
    return UsageError(f"{OPTION}: not permitted here: {reason}")
