"""How a board gets going: by itself, when it is powered; we reboot it for each episode."""

from __future__ import annotations

from firmware_sim.external.airframe_check import Airframe
from firmware_sim.external.bridge import no_process
from firmware_sim.external.px4.hitl import SILENCE_S, HitlBridge, check_line
from firmware_sim.external.transport.router import Router
from firmware_sim.mavlink.endpoint import Endpoint
from firmware_sim.mavlink.udp_links import UdpLinks


class HitlLauncher:
    """Finds the same board for each episode. Implements `boot_sequence.Launcher`."""

    may_set = False
    reboots = True

    def __init__(
        self,
        airframe: Airframe,
        router: Router,
        device: str,
        baud: int,
        timeout_s: float,
        *,
        silence_s: float = SILENCE_S,
    ) -> None:
        """Take where the board is.

        Args:
            airframe: What it must be set to.
            router: Where its MAVLink goes.
            device: Serial device.
            baud: Bits a second.
            timeout_s: Longest wait for it to be heard [wall s].
            silence_s: Longest time between motor commands [wall s].

        Raises:
            UsageError: The line is too slow.
        """
        check_line(device, baud)
        self.airframe = airframe
        self._router = router
        self._device, self._baud = device, baud
        self._timeout_s, self._silence_s = timeout_s, silence_s
        self._bridge: HitlBridge | None = None

    def launch(self) -> HitlBridge:
        """Find the board and reboot it; see `boot_sequence.Launcher`."""
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
            self._bridge.wait_connected(self._timeout_s, no_process)
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


def clients_of(ends: UdpLinks) -> dict[str, Endpoint]:
    """Return whom a board's frames are passed to, by the name of the link."""
    return {"onboard": ends.api, "gcs": ends.gcs}
