"""Position: what PX4 flies in it without a pilot's input."""

from __future__ import annotations

from airl_mav.control.demand import Demand
from airl_mav.core.frames import Vector, quat_yaw
from firmware_sim.autopilot.error_state import RATES, Q
from firmware_sim.autopilot.modes.interface import FREE, NAN, FlightContext, FlightMode
from firmware_sim.autopilot.requests import Request

FALLBACK_DESCENT_M_S = 0.75
"""Descent in Position mode without a pilot's input (measured on PX4 1.16). The vehicle stays
level: drag alone slows it, from 1.0 to 0.3 m/s in 7 s (FlightTaskDescend)."""


class Position(FlightMode):
    """Descends, level."""

    def __init__(self, _context: FlightContext, /) -> None:
        self._yaw = 0.0

    def enter(self, state: Vector, _request: Request | None, /) -> None:
        """Begin with the present heading."""
        self._yaw = quat_yaw(state[Q:RATES])

    def demand(self, _state: Vector, _time_us: int, /) -> Demand:
        """Descend."""
        return Demand(FREE, (NAN, NAN, FALLBACK_DESCENT_M_S), self._yaw, NAN)
