"""Turns: simulated time is frozen while the companion works, until it reports its wake-up time."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol, TypeAlias

from airl_mav.core.constants import US_PER_S
from companion.lockstep_turns import Poll

COMPANION_STARTS_US = US_PER_S // 10
"""Delay from the boot of the flight controller to the start of the companion [µs]."""


class LockstepError(Exception):
    """Violation of the lockstep protocol by the companion, described in the message."""


@dataclass(frozen=True)
class Turn:
    """End of the companion's turn."""

    wake_us: int | None
    """Requested time of the next turn [µs of simulated time]; None = the companion has ended."""
    interrupt: threading.Event | None = None
    """Event that wakes the companion earlier; None = no event."""
    setpoints_sent: int = 0
    """Number of setpoints that the companion has passed to MAVSDK so far."""
    poll: Poll | None = None
    """Condition that postpones `wake_us`; None = no condition."""


Handle: TypeAlias = "Callable[[bytes], threading.Event | None]"
"""Handler of a frame from the companion, which answers with `Partner.send`. If the answer takes
simulated time, the handler returns an event that is set on its arrival. The companion is blocked
inside MAVSDK, and must be interrupted until then."""


class Partner(Protocol):
    """Interface between the conductor and a companion, in a thread or behind a socket."""

    def send(self, frames: Sequence[bytes]) -> None:
        """Forward telemetry (MAVLink frames); delivered before the companion's next turn begins."""
        ...

    def turn(self, now_us: int, handle: Handle) -> Turn:
        """Let the companion run until it sleeps; simulated time is constant at `now_us` [µs].

        Args:
            now_us: Simulated time [µs].
            handle: Called with every MAVLink frame that the companion sends.

        Raises:
            LockstepError: The companion does not return the turn.
        """
        ...
