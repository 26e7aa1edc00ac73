"""The camera in lockstep with another process.

Frames arrive over ZeroMQ as always, by the wall clock. Which of them the companion sees is decided
by its turn, which names the newest one that has reached it in simulated time.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from airl_mav.core.clock import Clock
from airl_mav.core.constants import US_PER_S
from companion.camera import FrameSource, ReceivedFrame
from companion.conducted import Abandoned
from companion.token_clock import TokenTurns
from companion.tokens import NO_FRAME


@dataclass
class TokenFrameSource:
    """Returns the frame that the turn names. Implements `camera.FrameSource`."""

    frames: FrameSource
    turns: TokenTurns
    """What names them."""
    clock: Clock
    """The companion's."""
    newest: ReceivedFrame | None = field(default=None, init=False)

    def latest(self) -> ReceivedFrame | None:
        """Return the frame that the turn names; None before the first.

        Raises Abandoned when it does not come.
        """
        wanted = self.turns.frame
        if wanted == NO_FRAME:
            return None
        if self.newest is None or self.newest.frame.sequence != wanted:
            self.newest = self._await(wanted)
        return self.newest

    def wait(self, newer_than_sequence: int, timeout_s: float) -> ReceivedFrame | None:
        """Wait for a frame that is not the one already seen; see `camera.FrameSource`.

        Here the time-out counts in simulated time.
        """
        clock, arrived = self.clock, self.turns.frame_arrived
        deadline_us = clock.time_us() + int(timeout_s * US_PER_S)
        while True:
            newest = self.latest()
            if newest is not None and newest.frame.sequence != newer_than_sequence:
                return newest
            if clock.time_us() >= deadline_us:
                return None
            arrived.clear()
            clock.sleep_until(deadline_us, arrived)

    def _await(self, wanted: int) -> ReceivedFrame:
        """Wait for a frame that is on its way through the operating system."""
        received, patience_s = self.frames.latest(), self.turns.patience_s
        waited_s = 0
        while received is None or received.frame.sequence != wanted:
            # It is sent again until the turn has been given back.
            seen = NO_FRAME if received is None else received.frame.sequence
            newer = self.frames.wait(newer_than_sequence=seen, timeout_s=1.0)
            if newer is None:
                waited_s += 1
                if waited_s >= patience_s:
                    raise Abandoned(
                        f"frame {wanted} of the camera did not come in {patience_s:g} s"
                    )
            else:
                received = newer
        return received
