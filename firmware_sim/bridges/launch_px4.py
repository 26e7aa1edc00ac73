"""How PX4 gets going: started by us from a build or a package, or by the user."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from airl_mav.profiles.vehicle import Corner
from firmware_sim.bridges.airframe import Px4Airframe, px4_airframe
from firmware_sim.bridges.child import FirmwareChild
from firmware_sim.bridges.px4 import Px4Bridge
from firmware_sim.bridges.px4_program import SIMULATOR_PORT, Px4Program, environment
from firmware_sim.bridges.workplace import Workplace
from firmware_sim.simulation import EpisodeSetup

OUTPUTS = "PWM_MAIN_FUNC{}"
"""Function of an output of PX4 SITL."""


class Px4Launcher:
    """Starts a PX4 for each episode, or waits for the user's. Implements `avionics.Launcher`."""

    name = "PX4"
    reboots = False

    def __init__(
        self,
        vehicle_motors: Sequence[Corner],
        program: Px4Program | None,
        instance: int,
        timeout_s: float,
        workplace: Workplace,
    ) -> None:
        """Take what is started.

        Args:
            vehicle_motors: Corner of the motor on each output.
            program: What to start; None = the user does.
            instance: PX4's instance number, which moves all its ports.
            timeout_s: Longest wait for it to connect [wall s].
            workplace: Where it runs and logs.
        """
        self.motors = vehicle_motors
        self.may_set = program is not None
        self._program = program
        self._instance = instance
        self._timeout_s = timeout_s
        self._workplace = workplace
        self._child: FirmwareChild | None = None

    def airframe(self, setup: EpisodeSetup) -> Px4Airframe:
        """Return what PX4 must be set to. Raises UsageError when the vehicle does not say."""
        return px4_airframe("px4", setup.vehicle, OUTPUTS)

    def launch(self, setup: EpisodeSetup) -> Px4Bridge:
        """Start PX4, or wait for the user's; see `avionics.Launcher`."""
        self.stop()
        alive: Callable[[], None] = _nobody_to_look_after
        bridge = Px4Bridge(SIMULATOR_PORT + self._instance)
        try:
            if self._program is not None:
                folder = self._workplace.fresh()
                number = 0 if setup.vehicle.px4 is None else setup.vehicle.px4.airframe
                self._child = FirmwareChild(
                    self.name,
                    self._program.command(self._instance, folder),
                    environment(number),
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
        """End the PX4 that was started."""
        child, self._child = self._child, None
        if child is not None:
            child.stop()

    def close(self) -> None:
        """End it for good; its temporary folder goes."""
        self.stop()
        self._workplace.close()


def _nobody_to_look_after() -> None:
    """Do nothing: the process is the user's."""
