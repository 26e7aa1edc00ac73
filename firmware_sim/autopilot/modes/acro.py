"""Acro: the sticks command body rates and thrust.

Source: PX4 1.16, MulticopterRateControl.
"""

from __future__ import annotations

from airl_mav.control.demand import RateDemand
from airl_mav.core.constants import DEG
from airl_mav.core.frames import Vector
from firmware_sim.autopilot.flight_modes import Mode
from firmware_sim.autopilot.modes.interface import FlightContext, FlightMode
from firmware_sim.autopilot.modes.stabilized import IDLE_THROTTLE, RELEASED
from firmware_sim.autopilot.modes.stick_motion import superexpo


class Acro(FlightMode, modes=(Mode.ACRO,)):
    """Body rates proportional to the sticks, and thrust linear in the throttle stick."""

    def __init__(self, context: FlightContext, /) -> None:
        self._context = context

    @property
    def lifts(self) -> bool:
        """True if the throttle stick commands thrust."""
        sticks = self._context.sticks
        return sticks is not None and sticks.throttle > IDLE_THROTTLE

    def demand(self, _state: Vector, _time_us: int, /) -> RateDemand:
        """Return the demand of the sticks."""
        value, sticks = self._context.value, self._context.sticks or RELEASED
        gentle, steep = value("MC_ACRO_EXPO"), value("MC_ACRO_SUPEXPO")
        roll = superexpo(sticks.roll, gentle, steep) * value("MC_ACRO_R_MAX") * DEG
        pitch = -superexpo(sticks.pitch, gentle, steep) * value("MC_ACRO_P_MAX") * DEG
        yaw = superexpo(sticks.yaw, value("MC_ACRO_EXPO_Y"), value("MC_ACRO_SUPEXPOY"))
        rates = (roll, pitch, yaw * value("MC_ACRO_Y_MAX") * DEG)
        return RateDemand(rates, 0.5 * (sticks.throttle + 1.0))
