"""Stabilized, identical to Manual for a multicopter: the sticks command tilt and thrust.

Source: PX4 1.16, MulticopterAttitudeControl::generate_attitude_setpoint and throttle_curve.
"""

from __future__ import annotations

import math
from collections.abc import Callable

from airl_mav.control.demand import AttitudeDemand
from airl_mav.core.constants import DEG
from airl_mav.core.frames import Vector, quat_yaw, wrap_pi
from airl_mav.vehicle.rotation import multiply
from firmware_sim.autopilot.error_state import RATES, Q
from firmware_sim.autopilot.flight_modes import Mode
from firmware_sim.autopilot.manual_control import Sticks
from firmware_sim.autopilot.modes.interface import FlightContext, FlightMode, since
from firmware_sim.autopilot.requests import ModeRequest

IDLE_THROTTLE = -0.9
"""Deflection below which a standing vehicle stays, and its heading setpoint follows the heading."""

RELEASED = Sticks(0.0, 0.0, 0.0, 0.0)
"""Centred sticks, used after stick loss until the failsafe acts."""


class Stabilized(FlightMode, modes=(Mode.MANUAL, Mode.STABILIZED)):
    """Tilt proportional to the sticks, thrust from the throttle stick."""

    def __init__(self, context: FlightContext, /) -> None:
        self._context = context
        self._yaw = 0.0
        self._time_us: int | None = None

    @property
    def lifts(self) -> bool:
        """True if the throttle stick commands thrust."""
        sticks = self._context.sticks
        return sticks is not None and sticks.throttle > IDLE_THROTTLE

    def enter(self, state: Vector, _request: ModeRequest | None, /) -> None:
        """Start with the current heading."""
        self._yaw, self._time_us = quat_yaw(state[Q:RATES]), None

    def demand(self, state: Vector, time_us: int, /) -> AttitudeDemand:
        """Return the demand of the sticks."""
        value, sticks = self._context.value, self._context.sticks or RELEASED
        dt, self._time_us = since(self._time_us, time_us), time_us
        rate = sticks.yaw * value("MPC_MAN_Y_MAX") * DEG
        if sticks.throttle < IDLE_THROTTLE:
            self._yaw = quat_yaw(state[Q:RATES])
        else:
            self._yaw = wrap_pi(self._yaw + rate * dt)
        most = value("MPC_MAN_TILT_MAX") * DEG
        roll, pitch = sticks.roll * most, -sticks.pitch * most
        tilt = math.hypot(roll, pitch)
        share = 1.0 if tilt <= most else most / tilt
        half = 0.5 * tilt * share
        scale = math.sin(half) / tilt if tilt > 0.0 else 0.0
        leaning = (math.cos(half), roll * scale, pitch * scale, 0.0)
        heading = (math.cos(self._yaw / 2.0), 0.0, 0.0, math.sin(self._yaw / 2.0))
        return AttitudeDemand(multiply(heading, leaning), rate, thrust_of(sticks.throttle, value))


def thrust_of(throttle: float, value: Callable[[str], float]) -> float:
    """Return the collective 0..1 of a throttle stick -1..1; centre = hover (MPC_THR_CURVE)."""
    low, high = value("MPC_MANTHR_MIN"), value("MPC_THR_MAX")
    if value("MPC_THR_CURVE") == 1.0:
        return low + 0.5 * (throttle + 1.0) * (high - low)
    hover = value("MPC_THR_HOVER")
    return hover + throttle * (high - hover if throttle > 0.0 else hover - low)
