"""Vertical trajectory of a take-off.

Source: PX4 1.16, `PositionSmoothing` on the vertical axis (`smooth_trajectory`). The jerk limit of
the speed is omitted; it delays a speed change by 0.1 s.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

from airl_mav.core.constants import GRAVITY_M_S2, US_PER_S
from airl_mav.core.frames import Vector
from airl_mav.core.kernels import kernel
from firmware_sim.autopilot.error_state import P
from firmware_sim.autopilot.smooth_trajectory import braking_speed
from firmware_sim.engine.record import (
    CLIMB_ENDED,
    NO_CLIMB,
    RAMPING,
    RISING,
    SETTLING,
    Fields,
    Record,
    new_controller,
)

DECIDE_US = 20_000
"""Decision period of a mode whose demand changes in flight [µs]. PX4's flight modes run at 50 Hz
(FlightModeManager)."""

SETTLED_M = 0.01
"""Distance to the take-off altitude from which it is held like any other altitude [m]."""

HEIGHT, SPEED, TARGET, HOME_DOWN, END, NEAR_GROUND = range(6)
"""Layout of `climb`: current height [m], vertical speed [m/s] (positive up), target height, home
(NED), height at which the take-off ends, and upper limit of the gentle climb."""

_BEGAN, _SPOOL_UP, _TAKES, _FROM, _UP_TO = range(5)
"""Layout of `ramp`: start of the spool-up [µs], durations of spool-up and ramp [s], first and last
speed of the ramp [m/s]."""

_GENTLY, _UP, _DOWN = range(3)
"""Rows of `climb_limits`, each in the order of `ClimbLimits`."""

_braking_speed = kernel(braking_speed)


class ClimbLimits(NamedTuple):
    """Limits of vertical motion."""

    speed_m_s: float
    acceleration_m_s2: float
    jerk_m_s3: float


@kernel
def move_on(c: Fields, now_us: int) -> None:
    """Advance the climb of a flight controller to a time [µs], which must not decrease."""
    own, row = c.climb, _DOWN
    # Near the ground a take-off climbs gently; settling always uses the full limits.
    if own[TARGET] > own[HEIGHT]:
        row = _GENTLY if c.climbs == RISING and own[HEIGHT] < own[NEAR_GROUND] else _UP
    speed, acceleration, jerk = (
        c.climb_limits[row, 0],
        c.climb_limits[row, 1],
        c.climb_limits[row, 2],
    )
    # The first step has no time before it and changes nothing.
    elapsed_s = 0.0 if c.climb_us < 0 else (now_us - c.climb_us) / US_PER_S
    c.climb_us = now_us
    own[HEIGHT] += own[SPEED] * elapsed_s
    left_m = own[TARGET] - own[HEIGHT]
    # Maximum speed from which braking is still possible.
    target_speed = math.copysign(
        min(speed, _braking_speed(abs(left_m), acceleration, jerk)), left_m
    )
    # Acceleration limit: bounds the change of speed in this step.
    most = acceleration * elapsed_s
    own[SPEED] += min(most, max(-most, target_speed - own[SPEED]))


@kernel
def ramp_m_s(ramp: Vector, now_us: int) -> float:
    """Return the limit of the vertical speed on the ground [m/s].

    Source: PX4's Takeoff. After COM_SPOOLUP_TIME, the limit rises over MPC_TKO_RAMP_T from the
    value for zero thrust to the take-off speed.
    """
    ramp_s = (now_us - ramp[_BEGAN]) / US_PER_S - ramp[_SPOOL_UP]
    limit_m_s = ramp[_FROM]
    if ramp_s > 0.0:
        limit_m_s += min(1.0, ramp_s / ramp[_TAKES]) * (ramp[_UP_TO] - limit_m_s)
    return float(limit_m_s)


@kernel
def climb_if_due(c: Fields) -> bool:
    """Update the demand from the climb if due; return whether the take-off has ended."""
    own = c.climb
    if c.climbs not in (RAMPING, RISING, SETTLING) or c.time_us < c.climb_due_us:
        return False
    if c.climbs == RAMPING:
        limit_m_s = ramp_m_s(c.ramp, c.time_us)
        # Down is positive in the demand, so the larger value is the slower climb.
        c.climb_due_us, c.demand[5] = c.time_us + DECIDE_US, max(-own[SPEED], -limit_m_s)
        own[SPEED] = max(0.0, limit_m_s)
        return False
    if c.climbs == RISING:
        # Height of the vehicle, not of the trajectory, ends the take-off.
        height_m = own[HOME_DOWN] - c.state[P + 2]
        if height_m > own[END]:
            c.climbs = CLIMB_ENDED
            return True
        own[HEIGHT] = height_m
    move_on(c, c.time_us)
    c.climb_due_us, c.demand[5] = c.time_us + DECIDE_US, -own[SPEED]
    # Settling holds a height; rising commands only a speed.
    if c.climbs == SETTLING:
        c.demand[2] = own[HOME_DOWN] - own[HEIGHT]
        if abs(own[TARGET] - own[HEIGHT]) <= SETTLED_M:
            c.climbs = CLIMB_ENDED
    return False


@kernel
def climb_record(controller: Record) -> bool:
    """Update the demand from the climb of a record (1,), like `climb_if_due`."""
    return bool(climb_if_due(controller[0]))


@kernel
def _move_record_on(controller: Record, now_us: int) -> None:
    move_on(controller[0], now_us)


class Climb:
    """Vertical trajectory to a height with limited acceleration.

    After `fly`, compiled ticks advance the trajectory.
    """

    def __init__(self, record: Record | None = None) -> None:
        """Use the record of a flight controller; None = a new record."""
        self._record = record = new_controller() if record is None else record
        self._own, self._limits = record["climb"][0], record["climb_limits"][0]

    height_m = property(lambda self: self._own.item(HEIGHT))
    """Current height [m]."""
    speed_m_s = property(lambda self: self._own.item(SPEED))
    """Current vertical speed, positive up [m/s]."""

    @property
    def flies(self) -> bool:
        """True if compiled ticks advance the trajectory."""
        return self._record["climbs"].item(0) in (RAMPING, RISING, SETTLING)

    @property
    def has_ended(self) -> bool:
        """True if the climb has ended and its mode has not processed the end yet."""
        return bool(self._record["climbs"].item(0) == CLIMB_ENDED)

    def restart(self, speed_m_s: float) -> None:
        """Continue from a vertical speed [m/s]."""
        self._own[SPEED], self._record["climb_us"] = speed_m_s, -1

    def stop(self, *, ended: bool = False) -> None:
        """Leave the demand to Python; `ended` = until the mode has processed the end."""
        self._record["climbs"] = CLIMB_ENDED if ended else NO_CLIMB

    def ramp(
        self, began_us: int, value: Callable[[str], float], time_us: int, *, flies: bool
    ) -> float:
        """Restart the climb at a time [µs] of the ground ramp; return the speed limit [m/s].

        Args:
            began_us: Start of the spool-up [µs].
            value: Look-up for PX4 parameters by name.
            time_us: Current time, increasing from call to call.
            flies: True if compiled ticks continue the climb.
        """
        ramp, record = self._record["ramp"][0], self._record
        ramp[_BEGAN:_TAKES] = began_us, value("COM_SPOOLUP_TIME")
        # A ramp of 0 s would divide by zero.
        ramp[_TAKES] = max(value("MPC_TKO_RAMP_T"), 1e-3)
        # PX4's Takeoff: the ramp starts where the velocity controller commands zero thrust.
        ramp[_FROM:] = -GRAVITY_M_S2 / value("MPC_Z_VEL_P_ACC"), value("MPC_TKO_SPEED")
        record["climbs"] = RAMPING if flies else NO_CLIMB
        record["climb_due_us"] = time_us + DECIDE_US
        limit_m_s = ramp_m_s(ramp, time_us)
        self.restart(max(0.0, limit_m_s))
        return limit_m_s

    def aim(
        self,
        target_m: float,
        home_down_m: float,
        end_m: float,
        near_ground_m: float,
        limits: tuple[ClimbLimits, ClimbLimits, ClimbLimits],
    ) -> None:
        """Set the target of the climb.

        Args:
            target_m: Height above home [m].
            home_down_m: Home, local NED [m].
            end_m: Height at which the take-off ends [m].
            near_ground_m: Upper limit of the gentle climb of a take-off [m].
            limits: Limits near the ground, upwards and downwards.
        """
        self._own[TARGET:] = target_m, home_down_m, end_m, near_ground_m
        self._limits[:] = limits

    def fly(self, kind: int, time_us: int, height_m: float | None = None) -> None:
        """Advance to a time [µs] and let compiled ticks continue.

        Args:
            kind: `RISING` or `SETTLING`.
            time_us: Current time, increasing from call to call.
            height_m: Height of the vehicle; None = height of the trajectory.
        """
        if height_m is not None:
            self._own[HEIGHT] = height_m
        self._record["climbs"] = kind
        self._record["climb_due_us"] = time_us + DECIDE_US
        _move_record_on(self._record, time_us)
