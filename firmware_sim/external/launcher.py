"""Launcher of external firmware: starts it for each flight, or waits for the user's firmware."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Protocol

from airl_mav.core.files import PARTIAL_SUFFIX
from firmware_sim.external.airframe_check import RequiredAirframe
from firmware_sim.external.process import FirmwareProcess, StartCommand, WorkingFolders
from firmware_sim.flight_log.flight_log import ULOG_SUFFIX
from firmware_sim.interfaces import (
    ActuatorControls,
    FirmwareLostError,
    FirmwareMissingError,
    SensorSample,
    TrueState,
)


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

    def step(self, sample: SensorSample) -> ActuatorControls:
        """Send a tick's sensors; return the motor commands until the next tick.

        Raises:
            FirmwareLostError: The firmware died, hangs, or sends invalid data.
            FirmwareMissingError: The firmware is connected, but cannot be flown.
        """

    def use_truth(self, truth: Callable[[], TrueState]) -> None:
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
        reboots: bool = True,
        program: Callable[[Path], StartCommand] | None = None,
        folders: WorkingFolders | None = None,
    ) -> None:
        """Configure the launch; `bridge` opens the simulator interface for one flight.

        `timeout_s` is the connection timeout [wall s]; `reboots`: the firmware reboots on command.
        `program` writes files to an empty working folder and returns the command to run there;
        None = the user starts the firmware.
        """
        self.airframe = airframe
        self.may_set = program is not None
        """True if parameters may be changed: the firmware was started here for this flight."""
        self.reboots = reboots
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
        except FirmwareLostError as error:
            child = self._child
            exited = None if child is None else child.poll()
            if child is None or exited is None or exited.by_signal:
                raise
            tail = child.log_tail().splitlines()
            raise FirmwareMissingError(
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
        written = None if self._folders is None else self._folders.newest(ULOG_SUFFIX)
        if path is None or written is None:
            return
        partial = path.with_name(path.name + PARTIAL_SUFFIX)
        try:
            shutil.copyfile(written, partial)
            partial.replace(path)
        except OSError:
            # Disk full: the flight is valid without this log.
            partial.unlink(missing_ok=True)

    def close(self) -> None:
        """Stop the firmware and remove temporary folders."""
        self.stop()
        if self._folders is not None:
            self._folders.close()
