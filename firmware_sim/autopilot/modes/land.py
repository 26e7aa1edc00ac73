"""Land: stop, then descend vertically."""

from __future__ import annotations

import math
from collections.abc import Callable

from airl_mav.control.demand import Demand
from airl_mav.core.frames import Vector
from airl_mav.vehicle.rotation import Vec
from firmware_sim.autopilot.error_state import P, V
from firmware_sim.autopilot.flight_modes import Mode
from firmware_sim.autopilot.modes.interface import (
    FREE,
    NAN,
    FlightContext,
    FlightMode,
    here,
    over,
    triple,
)
from firmware_sim.autopilot.requests import ModeRequest, PositionYaw

STANDING_M_S = 0.3
"""Horizontal speed below which the descent holds a position [m/s]."""


SLOW_BELOW_M = 0.5
"""Margin below MPC_LAND_ALT2 that exceeds the estimate's error [m]."""


class Land(FlightMode, modes=(Mode.LAND,)):
    """Land mode: descends at the position of the stop, with PX4's decreasing speed."""

    def __init__(self, context: FlightContext, /) -> None:
        self._context = context
        self._place = PositionYaw((0.0, 0.0, 0.0), 0.0)
        self._stopping, self._began = False, (0.0, 0.0)
        self._is_slow = False

    @property
    def is_steady(self) -> bool:
        """True if the vehicle descends to its place at touchdown speed."""
        return self._is_slow and not self._stopping

    @property
    def destination(self) -> Vec | None:
        """Ground below the start of the mode, at home altitude."""
        north, east = self._began
        return north, east, self._context.home[2]

    def enter(self, state: Vector, _request: ModeRequest | None, /) -> None:
        """Start at the current position."""
        self._place, self._stopping = here(state), True
        self._began = self._place.position[:2]

    def demand(self, state: Vector, _time_us: int, /) -> Demand:
        """Stop first, then hold that position; descend at all times."""
        context = self._context
        height_m, ground_m = context.height(state), context.ground_m
        speed = landing_speed(context.value, height_m, ground_m)
        low_m = context.value("MPC_LAND_ALT2") - SLOW_BELOW_M
        self._is_slow = math.isnan(ground_m) and height_m < low_m
        if self._stopping:
            north, east, _ = triple(state, V)
            if math.hypot(north, east) > STANDING_M_S:
                self._place = self._place._replace(position=triple(state, P))
                return Demand(FREE, (0.0, 0.0, speed), self._place.yaw, NAN)
            self._stopping = False
        return over(self._place, speed)


def landing_speed(value: Callable[[str], float], height_m: float, ground_m: float = NAN) -> float:
    """Return the descent speed [m/s]: PX4 slows down linearly between two heights.

    Args:
        value: Look-up for parameters.
        height_m: Height above the landing place.
        ground_m: Height above ground, which takes precedence; NaN = unknown.
    """
    if not math.isnan(ground_m):
        if ground_m <= value("MPC_LAND_ALT3"):
            return value("MPC_LAND_CRWL")
        height_m = ground_m
    low, high = value("MPC_LAND_ALT2"), value("MPC_LAND_ALT1")
    slow, fast = value("MPC_LAND_SPEED"), value("MPC_Z_V_AUTO_DN")
    if height_m <= low:
        return slow
    if height_m >= high:
        return fast
    return slow + (fast - slow) / (high - low) * (height_m - low)
