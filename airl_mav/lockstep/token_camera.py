"""The camera's frames in lockstep when the companion is another process."""

from __future__ import annotations

from airl_mav.camera.frame import Frame
from airl_mav.lockstep.camera import UnderWay
from companion.tokens import NO_FRAME
from firmware_sim.firmware import FrameServer


class TokenCamera:
    """Holds frames back until they may be seen. Implements `firmware.FrameServer`.

    Only the newest frame that has arrived when a turn begins is sent: the companion could not see
    any other.
    """

    def __init__(self, server: FrameServer, transport_us: int) -> None:
        """Take where the frames go, and the time from a frame's exposure until it arrives [µs]."""
        self.under_way = UnderWay(transport_us)
        self.endpoint = server.endpoint
        self._server = server
        self._newest: Frame | None = None

    def publish(self, frame: Frame) -> None:
        """Send a frame on its way, in simulated time."""
        self.under_way.send(frame)

    def arrive(self, now_us: int) -> bool:
        """Take in what has arrived by `now_us` [µs]; return whether that is anything."""
        arrived = self.under_way.arrived(now_us)
        self._newest = arrived or self._newest
        return arrived is not None

    @property
    def sequence(self) -> int:
        """Sequence of the newest frame that has arrived."""
        return NO_FRAME if self._newest is None else self._newest.sequence

    def send(self) -> None:
        """Send that frame, by the wall clock; also again, to whoever may have missed it."""
        if self._newest is not None:
            self._server.publish(self._newest)

    def close(self) -> None:
        """Forget all frames; the server is its owner's to close."""
        self.under_way.clear()
