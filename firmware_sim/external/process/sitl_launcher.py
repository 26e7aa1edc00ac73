"""Starts SITL firmware for each flight, or waits for one that the user starts.

What differs between PX4 and ArduPilot is in `px4.program` and `ardupilot.program`.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from firmware_sim.external.airframe_check import Airframe
from firmware_sim.external.bridge import Bridge, no_process
from firmware_sim.external.process.firmware_process import FirmwareProcess, StartCommand
from firmware_sim.external.process.working_folders import WorkingFolders


class SitlLauncher:
    """Starts a program for each flight, or waits for the user's. A `boot_sequence.Launcher`."""

    def __init__(
        self,
        airframe: Airframe,
        bridge: Callable[[], Bridge],
        program: Callable[[Path], StartCommand] | None,
        folders: WorkingFolders,
        *,
        timeout_s: float,
        reboots: bool,
    ) -> None:
        """Take what is started, and its simulator interface.

        Args:
            airframe: What it must be configured to.
            bridge: Opens the simulator interface for one flight.
            program: Called with an empty working folder, which it may write files to; returns the
                command that starts the program there. None = the user starts it.
            folders: Its working folders and log.
            timeout_s: Longest wait for it to connect [wall s].
            reboots: Whether it comes up again when told to reboot.
        """
        self.airframe = airframe
        self.may_set = program is not None
        self.reboots = reboots
        self._bridge = bridge
        self._program = program
        self._folders = folders
        self._timeout_s = timeout_s
        self._child: FirmwareProcess | None = None

    def launch(self) -> Bridge:
        """Start it, or wait for the user's; see `boot_sequence.Launcher`."""
        self.stop()
        alive = no_process
        bridge = self._bridge()
        try:
            if self._program is not None:
                folder = self._folders.fresh()
                self._child = FirmwareProcess(
                    self.airframe.firmware, self._program(folder), folder, self._folders.log
                )
                alive = self._child.check
            bridge.wait_connected(self._timeout_s, alive)
        except BaseException:
            bridge.close()
            self.stop()
            raise
        return bridge

    def stop(self) -> None:
        """End what was started."""
        child, self._child = self._child, None
        if child is not None:
            child.stop()

    def close(self) -> None:
        """End it for good, and remove its temporary folder."""
        self.stop()
        self._folders.close()
