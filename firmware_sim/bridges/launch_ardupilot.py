"""How ArduPilot gets going: started by us from a build, or by the user."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from airl_mav.profiles.vehicle import Corner
from firmware_sim.bridges.airframe import ArduPilotAirframe, ardupilot_airframe
from firmware_sim.bridges.ardupilot import ArdupilotBridge
from firmware_sim.bridges.ardupilot_program import (
    PARAMETERS,
    Links,
    command,
    parameter_file,
    simulator_port,
)
from firmware_sim.bridges.child import FirmwareChild
from firmware_sim.bridges.workplace import Workplace
from firmware_sim.simulation import EpisodeSetup


class ArdupilotLauncher:
    """Starts an ArduCopter for each episode, or waits for the user's. A `avionics.Launcher`."""

    name = "ArduPilot"
    reboots = True

    def __init__(
        self,
        motors: Sequence[Corner],
        program: Path | None,
        instance: int,
        links: Links,
        timeout_s: float,
        workplace: Workplace,
    ) -> None:
        """Take what is started.

        Args:
            motors: Corner of the motor on each output.
            program: What to start; None = the user does.
            instance: ArduPilot's instance number.
            links: Where its MAVLink goes.
            timeout_s: Longest wait for it to connect [wall s].
            workplace: Where it runs and logs.
        """
        self.motors = motors
        self.may_set = program is not None
        self._program = program
        self._instance = instance
        self._links = links
        self._timeout_s = timeout_s
        self._workplace = workplace
        self._child: FirmwareChild | None = None

    def airframe(self, setup: EpisodeSetup) -> ArduPilotAirframe:
        """Return what it must be set to. Raises UsageError when the vehicle does not say."""
        return ardupilot_airframe("ardupilot", setup.vehicle)

    def launch(self, setup: EpisodeSetup) -> ArdupilotBridge:
        """Start ArduCopter, or wait for the user's; see `avionics.Launcher`."""
        self.stop()
        alive: Callable[[], None] = _nobody_to_look_after
        bridge = ArdupilotBridge(simulator_port(self._instance))
        try:
            if self._program is not None:
                folder = self._workplace.fresh()
                settings = self.airframe(setup).settings
                (folder / PARAMETERS).write_text(parameter_file(settings), encoding="ascii")
                self._child = FirmwareChild(
                    self.name,
                    command(str(self._program), self._instance, self._links, PARAMETERS),
                    {},
                    folder,
                    self._workplace.log,
                )
                alive = self._child.check
            bridge.wait_connected(self._timeout_s, alive)
        except BaseException:
            bridge.close()
            self.stop()
            raise
        return bridge

    def stop(self) -> None:
        """End the ArduCopter that was started."""
        child, self._child = self._child, None
        if child is not None:
            child.stop()

    def close(self) -> None:
        """End it for good; its temporary folder goes."""
        self.stop()
        self._workplace.close()


def _nobody_to_look_after() -> None:
    """Do nothing: the process is the user's."""
