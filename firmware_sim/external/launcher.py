"""Launcher of external firmware: starts it for each flight, or waits for the user's firmware."""

from __future__ import annotations

import os
import select
import shutil
import tempfile
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

import psutil

from airl_mav.core import child_process, clock, files
from airl_mav.core.frames import Goal
from firmware_sim import interfaces
from firmware_sim.external.parameters import RequiredAirframe

if TYPE_CHECKING:  # It loads the simulator.
    from firmware_sim.plant.body import PlantBody

REBOOT, SHUT_DOWN = 1, 2
"""First parameter of PREFLIGHT_REBOOT_SHUTDOWN."""


def no_process() -> None:
    """Check nothing: firmware started by the user has no child process here."""


class Bridge(Protocol):
    """Simulator interface of one firmware for one flight, without its MAVLink."""

    rate_hz: int
    """Required sensor samples per second of simulated time [Hz]."""
    armed: bool
    """True if the simulator interface last reported armed; False before the first report."""
    time_us: int
    """Firmware's time of the newest exchange [µs]; 0 before the first exchange."""

    def wait_connected(self, timeout_s: float, alive: Callable[[], None]) -> None:
        """Wait until the firmware has connected, at most `timeout_s` [wall s].

        `alive` is polled here and by every later `step` that waits, and raises if the process has
        died.

        Raises:
            FirmwareMissingError: The firmware did not connect in time.
            FirmwareLostError: Raised by `alive`.
        """

    def step(self, sample: interfaces.SensorSample) -> interfaces.ActuatorControls:
        """Send a tick's sensors; return the motor commands until the next tick.

        Raises:
            FirmwareLostError: The firmware died, hangs, or sends invalid data.
            FirmwareMissingError: The firmware is connected, but cannot be flown.
        """

    def use_truth(self, truth: Callable[[], interfaces.TrueState]) -> None:
        """Set the source of the true state."""

    def close(self) -> None:
        """Release all resources. Idempotent."""


class Launcher:
    """Launcher of one kind of firmware for each flight: bridge, and process if started here."""

    def __init__(
        self,
        airframe: RequiredAirframe,
        bridge: Callable[[], Bridge],
        timeout_s: float,
        *,
        farewell: int | None = REBOOT,
        program: Callable[[Path], StartCommand] | None = None,
        folders: WorkingFolders | None = None,
    ) -> None:
        """Configure the launch; `bridge` opens the simulator interface for one flight.

        `timeout_s` is the connection timeout [wall s]. `farewell` ends the user's firmware after a
        flight: `REBOOT`, `SHUT_DOWN`, None = it keeps running. `program` writes files to an empty
        working folder and returns the command to run there; None = the user starts the firmware.
        """
        self.airframe = airframe
        self.may_set = program is not None
        """True if parameters may be changed: the firmware was started here for this flight."""
        self.farewell = farewell
        self.body_by: Callable[..., PlantBody] | None = None
        """Factory of a body that moves elsewhere, see `plant.new_body`; None = a simulated one."""
        self.local: Callable[[Goal], Goal] = lambda goal: goal
        """Return a goal of the arena in the firmware's local frame."""
        self.title: Callable[[], str] = lambda: ""
        """Return the source of the poses of a body that moves elsewhere."""
        self._open_bridge = bridge
        self._program, self._folders = program, folders
        self._timeout_s = timeout_s
        self.flight_log: Path | None = None
        """Destination of the firmware's flight log after the flight; None = not copied."""
        self._bridge: Bridge | None = None
        self._child: FirmwareProcess | None = None

    def launch(self) -> Bridge:
        """Start the firmware, or wait for it, and return the connected bridge.

        Raises:
            UsageError: A port or device cannot be opened.
            FirmwareMissingError: The firmware cannot be started, exits early or never connects.
            FirmwareLostError: The firmware died during start-up.
        """
        self.stop()
        alive = no_process
        self._bridge = bridge = self._open_bridge()
        try:
            if self._program is not None and self._folders is not None:
                folder = self._folders.fresh()
                self._child = FirmwareProcess(
                    self.airframe.firmware, self._program(folder), folder, self._folders.log
                )
                alive = self._child.check
            self._await(bridge, alive)
        except BaseException:
            self.stop()
            raise
        return bridge

    def _await(self, bridge: Bridge, alive: Callable[[], None]) -> None:
        """Wait for the connection; FirmwareMissingError also if the program exits first."""
        try:
            bridge.wait_connected(self._timeout_s, alive)
        except interfaces.FirmwareLostError as error:
            child = self._child
            exited = None if child is None else child.poll()
            if child is None or exited is None or exited.by_signal:
                raise
            tail = child.log_tail().splitlines()
            raise interfaces.FirmwareMissingError(
                f"{child.name} ended at once ({exited}): {tail[-1] if tail else 'no word of it'}; "
                f"log: {child.log}"
            ) from error

    def stop(self) -> None:
        """Close the bridge and stop the process started here, if any. Idempotent."""
        if self._bridge is not None:
            self._bridge.close()
        child, self._child = self._child, None
        if child is not None:
            child.stop()
            self._keep_flight_log()

    def _keep_flight_log(self) -> None:
        path, self.flight_log = self.flight_log, None
        if path and self._folders and (written := self._folders.newest(path.suffix)):
            # Disk full: the flight is valid without this log.
            with suppress(OSError), files.replacing(path, 0o600) as partial:
                shutil.copyfile(written, partial)

    def close(self) -> None:
        """Stop the firmware and remove temporary folders."""
        self.stop()
        if self._folders is not None:
            self._folders.close()


REST_LIMIT_S = 1.0
"""Timeout until all threads sleep [wall s]; a thread that never sleeps must not stop a flight."""

LOOKS = 2
"""Consecutive samples with all threads asleep before the program counts as idle: a thread may wake
another between the reads of their states."""

PAUSE_S = 1e-4
"""Pause between samples while a thread is busy [wall s]; the thread may need this core."""

_STATE_BYTES = 80
"""Bytes read of a thread's `stat`, enough for number, name and state."""


class RunningProgram:
    """Running process, with a check for idle threads."""

    def __init__(self, pid: int, watched: Collection[bytes]) -> None:
        """Set the process id, and the names of the threads that `settle` waits for."""
        self.pid = pid
        self._watched = frozenset(watched)
        self._threads: list[int] | None = None
        """Descriptor of the `stat` of each watched thread; None = threads not searched yet."""

    @property
    def stopped(self) -> bool:
        """True if stopped by a signal: SIGSTOP, SIGTSTP."""
        try:
            return bool(psutil.Process(self.pid).status() == psutil.STATUS_STOPPED)
        except psutil.Error:
            return False

    def settle(self) -> bool:
        """Wait until the threads found at the first call sleep; False if unknown or timed out."""
        patience, looks = clock.Patience(), 0
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
        """Close the descriptors. Idempotent."""
        for descriptor in self._threads or ():
            os.close(descriptor)
        self._threads = []

    def _all_asleep(self) -> bool | None:
        """Return True if all watched threads are asleep; None = unknown."""
        try:
            if self._threads is None:
                self._threads = self._found()
            for descriptor in self._threads:
                if _state(os.pread(descriptor, _STATE_BYTES, 0)) != b"S":
                    return False
        except OSError:  # no /proc, or the program has ended
            return None
        return True

    def _found(self) -> list[int]:
        """Return the descriptors of the `stat` files of the watched threads."""
        found = []
        for thread in Path(f"/proc/{self.pid}/task").iterdir():
            descriptor = os.open(thread / "stat", os.O_RDONLY | os.O_CLOEXEC)
            if _name(os.pread(descriptor, _STATE_BYTES, 0)) in self._watched:
                found.append(descriptor)
            else:
                os.close(descriptor)
        return found


def program_at(host: str, port: int, to_port: int) -> int | None:
    """Return the process id of a TCP connection's client; None if unknown or of another user.

    `to_port` is the server's port: the client's port may also be connected elsewhere.
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
    """Command that starts a program in a working folder."""

    argv: Sequence[str]
    environment: Mapping[str, str]
    """Variables added to the environment of this process."""


class FirmwareProcess(child_process.ChildProcess):
    """Process of external firmware. It ends with this process, even if killed."""

    def __init__(self, name: str, command: StartCommand, cwd: Path, log: Path) -> None:
        """Start a program in a folder, appending output to `log`, or raise FirmwareMissingError."""
        self.name = name
        program = Path(command.argv[0])
        if not os.access(program, os.X_OK) or not program.is_file():
            raise interfaces.FirmwareMissingError(f"{name}: {program}: not an executable program")
        super().__init__(command.argv, log, guarded=True, cwd=cwd, environment=command.environment)

    def check(self) -> None:
        """Raise FirmwareLostError when the process has ended."""
        exited = self.poll()
        if exited is not None:
            tail = self.log_tail()
            raise interfaces.FirmwareLostError(
                f"{self.name} ended ({exited}); log: {self.log}" + (f"\n{tail}" if tail else "")
            )


class WorkingFolders:
    """Working folders, one per flight, for the firmware's parameters and flight logs."""

    def __init__(self, name: str, kept: Path | None, log: Path | None) -> None:
        """Choose the folders of a firmware, such as px4.

        `kept` is the parent of kept working folders, None = one temporary folder at a time; `log`
        receives the firmware's output, None = a file beside the working folders.
        """
        self._name = name
        self._flights = 0
        self._temporary = kept is None
        root = Path(tempfile.mkdtemp(prefix=f"airl-{name}-")) if kept is None else kept
        root.mkdir(parents=True, exist_ok=True)
        self._root = root.absolute()
        self.log = (log or root / f"{name}.log").absolute()

    def fresh(self) -> Path:
        """Return a new, empty working folder, without files of an earlier flight."""
        if self._temporary:
            shutil.rmtree(self._path, ignore_errors=True)
        while True:
            self._flights += 1
            # Parallel processes may use the same parent folder.
            with suppress(FileExistsError):
                self._path.mkdir()
                return self._path

    def newest(self, suffix: str) -> Path | None:
        """Return the most recently written file with a suffix in the present folder, if any."""
        found = self._path.rglob(f"*{suffix}")
        return max(found, key=lambda path: path.stat().st_mtime_ns, default=None)

    def close(self) -> None:
        """Remove temporary folders. Idempotent."""
        if self._temporary:
            shutil.rmtree(self._root, ignore_errors=True)

    @property
    def _path(self) -> Path:
        return self._root / f"{self._name}-{self._flights:03d}"
