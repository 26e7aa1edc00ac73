"""How a board gets going: by itself, when it is powered; we reboot it for each episode."""

from __future__ import annotations

from collections.abc import Sequence

from airl_mav.profiles.vehicle import Corner
from firmware_sim.bridges.airframe import Px4Airframe, px4_airframe
from firmware_sim.bridges.hitl import SILENCE_S, HitlBridge, check_line
from firmware_sim.bridges.router import Router
from firmware_sim.mavlink.endpoint import Endpoint
from firmware_sim.mavlink.px4_links import Px4Ends
from firmware_sim.simulation import EpisodeSetup

OUTPUTS = "HIL_ACT_FUNC{}"


class HitlLauncher:
    """Finds the same board for each episode. Implements `avionics.Launcher`."""

    name = "PX4"
    may_set = False
    reboots = True

    def __init__(
        self,
        motors: Sequence[Corner],
        router: Router,
        device: str,
        baud: int,
        timeout_s: float,
        *,
        silence_s: float = SILENCE_S,
    ) -> None:
        """Take where the board is.

        Args:
            motors: Corner of the motor on each output.
            router: Where its MAVLink goes.
            device: Serial device.
            baud: Bits a second.
            timeout_s: Longest wait for it to be heard [wall s].
            silence_s: Longest time between motor commands [wall s].

        Raises:
            UsageError: The line is too slow.
        """
        check_line(device, baud)
        self.motors = motors
        self._router = router
        self._device, self._baud = device, baud
        self._timeout_s, self._silence_s = timeout_s, silence_s
        self._bridge: HitlBridge | None = None

    def airframe(self, setup: EpisodeSetup) -> Px4Airframe:
        """Return what PX4 must be set to. Raises UsageError when the vehicle does not say."""
        return px4_airframe("px4-hitl", setup.vehicle, OUTPUTS)

    def launch(self, setup: EpisodeSetup) -> HitlBridge:
        """Find the board and reboot it; see `avionics.Launcher`."""
        del setup
        last = self._bridge
        self.stop()
        self._bridge = HitlBridge(
            self._router,
            self._device,
            self._baud,
            reboot=last is None or not last.went_down,
            returning=last is not None,
            silence_s=self._silence_s,
        )
        try:
            self._bridge.wait_connected(self._timeout_s, _nobody_to_look_after)
        except BaseException:
            self.stop()
            raise
        return self._bridge

    def stop(self) -> None:
        """Let go of the board."""
        if self._bridge is not None:
            self._bridge.close()

    def close(self) -> None:
        """Let go of the board for good."""
        self.stop()


def _nobody_to_look_after() -> None:
    """Do nothing: there is no process."""


def clients_of(ends: Px4Ends) -> dict[str, Endpoint]:
    """Return whom a board's frames are passed to, by the name of the link."""
    return {"onboard": ends.api, "gcs": ends.gcs}
