"""Turns: simulated time stands while the companion works; then it says until when it sleeps."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol, TypeAlias

from airl_mav.core.constants import US_PER_S
from companion.conducted import Poll

COMPANION_STARTS_US = US_PER_S // 10
"""The companion begins so long after the flight controller has booted [µs]."""


class LockstepError(Exception):
    """The companion does not keep to the turns; the message says how."""


@dataclass(frozen=True)
class Turn:
    """How the companion gave its turn back."""

    wake_us: int | None
    """When it wants the next one [µs of simulated time]; None: it has ended."""
    interrupt: threading.Event | None = None
    """Wakes it earlier when set."""
    setpoints_sent: int = 0
    """Setpoints that it has handed to MAVSDK so far."""
    poll: Poll | None = None
    """Postpones `wake_us`; None: nothing does."""


Handle: TypeAlias = "Callable[[bytes], threading.Event | None]"
"""Takes a frame of the companion's and answers by `Partner.send`. Where the answer takes simulated
time, it returns what is set when it has come: the companion, which waits for it inside MAVSDK, is
to be interrupted until then."""


class Partner(Protocol):
    """The companion as the conductor sees it, in a thread or behind a socket."""

    def send(self, frames: Sequence[bytes]) -> None:
        """Pass on telemetry, MAVLink frames; the companion has it when its next turn begins."""
        ...

    def turn(self, now_us: int, handle: Handle) -> Turn:
        """Let the companion work until it sleeps, while simulated time stands at `now_us` [µs].

        Args:
            now_us: Simulated time [µs].
            handle: Called with every MAVLink frame that the companion sends.

        Raises:
            LockstepError: The turn does not come back.
        """
        ...
