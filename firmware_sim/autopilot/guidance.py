"""What each mode flies: mode and estimate -> demand for the cascade."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from airl_mav.constants import GRAVITY_M_S2, US_PER_S
from airl_mav.control.cascade import Demand
from airl_mav.frames import Vector, quat_yaw
from firmware_sim.autopilot.commander import Phase
from firmware_sim.autopilot.state import Estimate, Mode, Setpoint

NAN = math.nan

FALLBACK_DESCENT_M_S = 0.75
"""Descent in Position mode without a pilot's sticks (measured on PX4 1.16)."""

TAKEOFF_REACHED_M = 0.2
"""Closer than this to the take-off altitude, take-off is done."""


def _triple(v: Vector) -> tuple[float, float, float]:
    return float(v[0]), float(v[1]), float(v[2])


@dataclass
class Anchor:
    """Where a mode began: what hold, take-off, landing and return refer to."""

    position: Vector  # (3,) NED [m]
    yaw: float
    time_us: int


class Guidance:
    """Turns the mode into a demand. Told of mode changes by `enter`."""

    def __init__(self, value: Callable[[str], float]) -> None:
        """Take a lookup of PX4 parameter names."""
        self._value = value
        self._mode = Mode.HOLD
        self._anchor = Anchor(np.zeros(3), 0.0, 0)
        self._braking = False
        self._return_leg = 0
        self._spool_since_us: int | None = None
        self._home = np.zeros(3)
        self.takeoff_altitude_m = 0.0
        """Height above home that a take-off climbs to [m]."""

    @property
    def _home_down(self) -> float:
        return float(self._home[2])

    def enter(self, mode: Mode, estimate: Estimate) -> None:
        """A new mode begins here and now."""
        self._mode = mode
        self._anchor = Anchor(
            estimate.position.copy(), quat_yaw(estimate.quaternion), estimate.time_us
        )
        self._braking = mode is Mode.HOLD
        self._return_leg = 0

    def at_home(self, estimate: Estimate) -> None:
        """Home (the ground under the vehicle at arming) is here."""
        self._home = estimate.position.copy()
        self._spool_since_us = None

    def wants_to_lift(self, setpoint: Setpoint | None) -> bool:
        """Return whether the mode asks a standing vehicle to leave the floor."""
        if self._mode is Mode.TAKEOFF:
            return True
        if self._mode is Mode.OFFBOARD and setpoint is not None:
            up = setpoint.velocity[2] < -0.1
            above = setpoint.position[2] < self._home_down - 0.3
            return bool(up or above)
        return False

    def climb_limit(self, phase: Phase, estimate: Estimate) -> float | None:
        """Return the greatest climb rate of the take-off ramp [m/s, up], None when it is over.

        PX4's Takeoff: after COM_SPOOLUP_TIME the vertical speed limit rises in MPC_TKO_RAMP_T
        from the value that commands zero thrust to the take-off speed.
        """
        if phase is Phase.AIR:
            self._spool_since_us = None
            return None
        if self._spool_since_us is None:
            self._spool_since_us = estimate.time_us
        value = self._value
        elapsed_s = (estimate.time_us - self._spool_since_us) / US_PER_S
        ramp_s = elapsed_s - value("COM_SPOOLUP_TIME")
        lowest = -GRAVITY_M_S2 / value("MPC_Z_VEL_P_ACC")
        if ramp_s <= 0.0:
            return lowest
        share = min(1.0, ramp_s / max(value("MPC_TKO_RAMP_T"), 1e-3))
        return lowest + share * (value("MPC_TKO_SPEED") - lowest)

    def stand(self) -> None:
        """The vehicle stands with idle motors: a later take-off spools up anew."""
        self._spool_since_us = None

    def takeoff_done(self, estimate: Estimate) -> bool:
        """Return whether a take-off has reached its altitude."""
        height = self._home_down - float(estimate.position[2])
        return self._mode is Mode.TAKEOFF and height > self.takeoff_altitude_m - TAKEOFF_REACHED_M

    def demand(self, estimate: Estimate, setpoint: Setpoint | None) -> Demand:
        """Return what to fly now."""
        if self._mode is Mode.OFFBOARD and setpoint is not None:
            return Demand(
                _triple(setpoint.position),
                _triple(setpoint.velocity),
                setpoint.yaw,
                setpoint.yaw_rate,
            )
        if self._mode is Mode.TAKEOFF:
            return self._takeoff(estimate)
        if self._mode is Mode.LAND:
            return self._land(estimate)
        if self._mode is Mode.RETURN:
            return self._return(estimate)
        if self._mode is Mode.POSITION:
            down = (0.0, 0.0, FALLBACK_DESCENT_M_S)
            return Demand((NAN, NAN, NAN), down, self._anchor.yaw, NAN)
        return self._hold(estimate)

    def _hold(self, estimate: Estimate) -> Demand:
        """Brake first, then hold the place where the vehicle came to rest."""
        anchor = self._anchor
        if self._braking:
            if float(np.linalg.norm(estimate.velocity)) > 0.3:
                anchor.position = estimate.position.copy()
                return Demand((NAN, NAN, NAN), (0.0, 0.0, 0.0), anchor.yaw, NAN)
            anchor.position = estimate.position.copy()
            self._braking = False
        return Demand(_triple(anchor.position), (NAN, NAN, NAN), anchor.yaw, NAN)

    def _vertical(self, estimate: Estimate, down_target: float, limit: float) -> float:
        """Return the vertical speed NED towards a height, limited [m/s]."""
        speed = self._value("MPC_Z_P") * (down_target - float(estimate.position[2]))
        return min(limit, max(-limit, speed))

    def _takeoff(self, estimate: Estimate) -> Demand:
        anchor = self._anchor
        target = self._home_down - self.takeoff_altitude_m
        # Aim a little above: the P law alone would take for ever over the last centimetres.
        speed = self._vertical(estimate, target - 0.5, self._value("MPC_TKO_SPEED"))
        north, east, _ = _triple(anchor.position)
        return Demand((north, east, NAN), (NAN, NAN, speed), anchor.yaw, NAN)

    def _land(self, estimate: Estimate) -> Demand:
        value, anchor = self._value, self._anchor
        height = self._home_down - float(estimate.position[2])
        # PX4 slows down linearly between the two heights.
        heights = (value("MPC_LAND_ALT2"), value("MPC_LAND_ALT1"))
        speed = float(
            np.interp(height, heights, (value("MPC_LAND_SPEED"), value("MPC_Z_V_AUTO_DN")))
        )
        if float(np.hypot(*estimate.velocity[:2])) > 0.3 and not self._braking:
            # Still moving: stop first, then hold that place while descending.
            anchor.position = estimate.position.copy()
            return Demand((NAN, NAN, NAN), (0.0, 0.0, speed), anchor.yaw, NAN)
        self._braking = True
        north, east, _ = _triple(anchor.position)
        return Demand((north, east, NAN), (NAN, NAN, speed), anchor.yaw, NAN)

    def _return(self, estimate: Estimate) -> Demand:
        """Climb to RTL_RETURN_ALT, fly home, land."""
        value, anchor = self._value, self._anchor
        height = self._home_down - float(estimate.position[2])
        away = float(np.hypot(*(estimate.position - self._home)[:2]))
        if self._return_leg == 0:
            target = max(value("RTL_RETURN_ALT"), height)
            if height > target - TAKEOFF_REACHED_M or away < value("NAV_ACC_RAD"):
                self._return_leg = 1
                anchor.position = estimate.position.copy()
            speed = self._vertical(
                estimate, self._home_down - target - 0.5, value("MPC_Z_VEL_MAX_UP")
            )
            north, east, _ = _triple(anchor.position)
            return Demand((north, east, NAN), (NAN, NAN, speed), anchor.yaw, NAN)
        if self._return_leg == 1:
            if away > 0.5:
                north, east = (float(c) for c in (estimate.position - self._home)[:2])
                cruise = min(value("MPC_XY_CRUISE"), value("MPC_XY_P") * away)
                velocity = (-north / away * cruise, -east / away * cruise, NAN)
                down = float(anchor.position[2])
                return Demand((NAN, NAN, down), velocity, anchor.yaw, NAN)
            self._return_leg = 2
            anchor.position = self._home.copy()
            self._braking = True  # almost at rest: descend to home itself
        return self._land(estimate)
