"""Descend: level descent without a position estimate or pilot input.

Source: PX4 1.16, FlightTaskDescend.
"""

from __future__ import annotations

from airl_mav.control.demand import Demand
from airl_mav.core.frames import Vector, quat_yaw
from firmware_sim.autopilot.error_state import RATES, Q
from firmware_sim.autopilot.flight_modes import Mode
from firmware_sim.autopilot.modes.interface import FREE, NAN, FlightContext, FlightMode
from firmware_sim.autopilot.requests import ModeRequest


class Descend(FlightMode, modes=(Mode.DESCEND,)):
    """Level descent at MPC_LAND_SPEED with constant heading."""

    def __init__(self, context: FlightContext, /) -> None:
        self._context = context
        self._yaw = 0.0

    def enter(self, state: Vector, _request: ModeRequest | None, /) -> None:
        """Start with the current heading."""
        self._yaw = quat_yaw(state[Q:RATES])

    def demand(self, _state: Vector, _time_us: int, /) -> Demand:
        """Return the descent demand."""
        return Demand(FREE, (NAN, NAN, self._context.value("MPC_LAND_SPEED")), self._yaw, NAN)
