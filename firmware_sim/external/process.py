"""Process of external firmware, its working folders, and the parent-death guard.

PX4 and ArduPilot do not end with their simulator. Process states are known on Linux only (/proc).
"""

from __future__ import annotations

import os
import select
import shutil
import tempfile
from collections.abc import Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import psutil

from airl_mav.core.child_process import ChildProcess
from airl_mav.core.clock import Patience
from firmware_sim.flight_controller import FirmwareLostError, FirmwareMissingError

REST_LIMIT_S = 1.0
"""Longest wait for all threads to be at rest [wall s]: one that never is must not stop a flight."""

LOOKS = 2
"""So many looks in a row find all threads asleep before they are taken to be: between the looks at
two threads one may have woken the other."""

PAUSE_S = 1e-4
"""Between two looks while a thread is at work [wall s]: it may need the core that we are on."""

_STATE_BYTES = 80
"""Of a thread's `stat`, enough to hold its number, name and state."""


class RunningProgram:
    """One process."""

    def __init__(self, pid: int, watched: Collection[bytes]) -> None:
        """Take its process id, and the names of the threads that `settle` waits for."""
        self.pid = pid
        self._watched = frozenset(watched)
        self._threads: list[int] | None = None
        """Descriptor of the `stat` of each thread that is waited for; None: not looked for yet."""

    @property
    def stopped(self) -> bool:
        """Whether it was stopped by a signal: SIGSTOP, SIGTSTP."""
        try:
            return bool(psutil.Process(self.pid).status() == psutil.STATUS_STOPPED)
        except psutil.Error:
            return False

    def settle(self) -> bool:
        """Return once all threads, found at the first call, sleep; False if unknown or too late."""
        patience, looks = Patience(), 0
        while looks < LOOKS:
            asleep = self._all_asleep()
            if asleep is None:
                return False
            if asleep:
                looks += 1
                continue
            looks = 0
            if patience.so_far_s() > REST_LIMIT_S:
                return False
            select.select([], [], [], PAUSE_S)
        return True

    def close(self) -> None:
        """Forget it; harmless when called again."""
        for descriptor in self._threads or ():
            os.close(descriptor)
        self._threads = []

    def _all_asleep(self) -> bool | None:
        """Return whether none of the threads is at work right now; None where nobody knows."""
        try:
            if self._threads is None:
                self._threads = self._found()
            for descriptor in self._threads:
                if _state(os.pread(descriptor, _STATE_BYTES, 0)) != b"S":
                    return False
        except OSError:  # There is no /proc, or the program has ended.
            return None
        return True

    def _found(self) -> list[int]:
        """Return what tells of each thread that is waited for."""
        found = []
        for thread in Path(f"/proc/{self.pid}/task").iterdir():
            descriptor = os.open(thread / "stat", os.O_RDONLY | os.O_CLOEXEC)
            if _name(os.pread(descriptor, _STATE_BYTES, 0)) in self._watched:
                found.append(descriptor)
            else:
                os.close(descriptor)
        return found


def program_at(host: str, port: int, to_port: int) -> int | None:
    """Return the process id of a TCP connection's client, None if unknown or of another user.

    `to_port` is the server's port: the client's own may also connect elsewhere.
    """
    with suppress(psutil.Error, OSError):
        for connection in psutil.net_connections("tcp4"):
            own, other = connection.laddr, connection.raddr
            if own and other and tuple(own) == (host, port) and other.port == to_port:
                return None if connection.pid in (None, os.getpid()) else int(connection.pid)
    return None


def _state(stat: bytes) -> bytes:
    """Return the state of a thread. Source: proc_pid_stat(5), field 3."""
    end = stat.rindex(b")")
    return stat[end + 2 : end + 3]


def _name(stat: bytes) -> bytes:
    return stat[stat.index(b"(") + 1 : stat.rindex(b")")]


@dataclass(frozen=True)
class StartCommand:
    """How a program is started in a folder of its own."""

    argv: Sequence[str]
    environment: Mapping[str, str]
    """Added to our own environment."""


class FirmwareProcess(ChildProcess):
    """One process of external firmware. It ends with us, also when we are killed."""

    def __init__(self, name: str, command: StartCommand, cwd: Path, log: Path) -> None:
        """Start a program in a folder, output appended to `log`, or raise FirmwareMissingError."""
        self.name = name
        program = Path(command.argv[0])
        if not os.access(program, os.X_OK) or not program.is_file():
            raise FirmwareMissingError(f"{name}: {program}: not an executable program")
        super().__init__(command.argv, log, guarded=True, cwd=cwd, environment=command.environment)

    def check(self) -> None:
        """Raise FirmwareLostError when the process has ended."""
        exited = self.poll()
        if exited is not None:
            tail = self.log_tail()
            raise FirmwareLostError(
                f"{self.name} ended ({exited}); log: {self.log}" + (f"\n{tail}" if tail else "")
            )


class WorkingFolders:
    """One working folder after the other; firmware keeps parameters and flight logs there."""

    def __init__(self, name: str, kept: Path | None, log: Path | None) -> None:
        """Choose the folders of a firmware, such as px4.

        `kept` keeps the working folders, None = temporary ones, one at a time; `log` holds its
        output, None = a file beside the working folders.
        """
        self._name = name
        self._flights = 0
        self._temporary = kept is None
        root = Path(tempfile.mkdtemp(prefix=f"airl-{name}-")) if kept is None else kept
        root.mkdir(parents=True, exist_ok=True)
        self._root = root.absolute()
        self.log = (log or root / f"{name}.log").absolute()

    def fresh(self) -> Path:
        """Return a new, empty working folder: nothing carries over from an earlier flight."""
        if self._temporary:
            shutil.rmtree(self._path, ignore_errors=True)
        while True:
            self._flights += 1
            # Processes that fly side by side may keep their folders in the same place.
            with suppress(FileExistsError):
                self._path.mkdir()
                return self._path

    def newest(self, suffix: str) -> Path | None:
        """Return the file with a suffix that was written last in the present folder, if any."""
        found = self._path.rglob(f"*{suffix}")
        return max(found, key=lambda path: path.stat().st_mtime_ns, default=None)

    def close(self) -> None:
        """Remove what is temporary; harmless when called again."""
        if self._temporary:
            shutil.rmtree(self._root, ignore_errors=True)

    @property
    def _path(self) -> Path:
        return self._root / f"{self._name}-{self._flights:03d}"
