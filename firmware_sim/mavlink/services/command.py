"""One command as a service sees it, and what a service does with it."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from firmware_sim.autopilot.autopilot_state import Result
from firmware_sim.mavlink.services.context import Context


@dataclass(frozen=True, slots=True)
class Command:
    """A COMMAND_LONG or COMMAND_INT."""

    number: int
    """MAV_CMD."""
    params: tuple[float, float, float, float, float, float, float]
    """Parameters 1..7 of COMMAND_LONG; NaN = not given."""
    sender: tuple[int, int] = (0, 0)
    """System and component id of who asks."""
    frame: int | None = None
    """MAV_FRAME of a COMMAND_INT."""

    def integer(self, number: int) -> int | None:
        """Return parameter 1..7 rounded, None when it is not a finite number."""
        value = self.params[number - 1]
        return round(value) if math.isfinite(value) else None


Action = Callable[[Command, Context], "Result | None"]
"""Carries out a command and returns the answer; None: it is not acknowledged, as by PX4."""
