"""Setpoint trajectories of the manual modes from stick deflections.

Source: PX4 1.16, Sticks, StickYaw, StickAccelerationXY, ManualVelocitySmoothingZ and
FlightTaskManualAltitude.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

from airl_mav.core.constants import DEG, GRAVITY_M_S2
from airl_mav.core.frames import wrap_pi
from firmware_sim.autopilot.smooth_trajectory import Axis

NAN = math.nan

_TURNS_RAD_S = 1e-3
"""Yaw rate above which no heading is held [rad/s]."""

_AT_REST_M_S, _AT_REST_M_S2 = 0.1, 0.2
"""Speed and acceleration below which a height is held."""

_BOOST_TAU_S = 0.8
"""Time constant of the increased drag after release of the stick [s]."""


def deadzone(x: float, zone: float) -> float:
    """Return a deflection with a deadzone; full deflection remains 1."""
    return 0.0 if abs(x) <= zone else math.copysign((abs(x) - zone) / (1.0 - zone), x)


def expo(x: float, share: float) -> float:
    """Return a deflection with reduced gain around the centre, by a share of x³."""
    return (1.0 - share) * x + share * x**3


def superexpo(x: float, share: float, steeper: float) -> float:
    """Return the `expo` of a deflection, steeper towards full deflection."""
    return expo(x, share) * (1.0 - steeper) / (1.0 - abs(x) * steeper)


Pair = tuple[float, float]
"""North and east components."""


class AxisDemand(NamedTuple):
    """Demand of one axis; NaN = no position."""

    position: float
    velocity: float
    acceleration: float


class YawStick:
    """Yaw stick commands a yaw rate; released, the heading is held."""

    def __init__(self, value: Callable[[str], float]) -> None:
        self._value = value
        self._rate = 0.0
        self._held = NAN

    def restart(self) -> None:
        """Reset rate and held heading."""
        self._rate, self._held = 0.0, NAN

    def turn(self, stick: float, yaw: float, dt: float) -> tuple[float, float]:
        """Return the heading [rad], NaN while turning, and the yaw rate [rad/s]."""
        value = self._value
        shaped = expo(deadzone(stick, value("MPC_HOLD_DZ")), value("MPC_YAW_EXPO"))
        wanted = shaped * value("MPC_MAN_Y_MAX") * DEG
        self._rate += (wanted - self._rate) * dt / (dt + value("MPC_MAN_Y_TAU"))
        if abs(self._rate) > _TURNS_RAD_S:
            self._held = NAN
        elif math.isnan(self._held):
            self._held = wrap_pi(yaw)
        return self._held, self._rate


class VerticalStick:
    """Throttle stick commands climb and descent; released, the height is held."""

    def __init__(self, value: Callable[[str], float]) -> None:
        self._value = value
        self._axis = Axis()
        self._held = NAN

    def restart(self, down: float, velocity: float) -> None:
        """Start with a position [m] and velocity [m/s], NED."""
        self._axis.restart(down, velocity)
        self._held = NAN

    def move(self, stick: float, down: float, height: float, dt: float) -> AxisDemand:
        """Return the demand, NED, from measured `down` and `height` above home [m]."""
        value, axis = self._value, self._axis
        shaped = expo(deadzone(stick, value("MPC_HOLD_DZ")), value("MPC_Z_MAN_EXPO"))
        wanted = self._speed(shaped, height)
        axis.advance(dt)
        resting = abs(axis.velocity) < _AT_REST_M_S and abs(axis.acceleration) < _AT_REST_M_S2
        if resting and wanted == 0.0:
            if math.isnan(self._held):
                self._held = axis.position
        else:
            self._held = NAN
            axis.position = down
        limit = value("MPC_ACC_UP_MAX") if wanted < 0.0 else value("MPC_ACC_DOWN_MAX")
        axis.plan(wanted, limit, value("MPC_JERK_MAX"))
        return AxisDemand(self._held, axis.velocity, axis.acceleration)

    def put(self, down: float) -> float:
        """Continue from another height NED [m]; return the held height, NaN = none."""
        self._axis.position = down
        if not math.isnan(self._held):
            self._held = down
        return self._held

    def _speed(self, shaped: float, height: float) -> float:
        """Return the speed NED [m/s], reduced near the ground."""
        value = self._value
        low, high = value("MPC_LAND_ALT2"), max(value("MPC_LAND_ALT1"), value("MPC_LAND_ALT2"))
        share = 1.0 if height >= high else 0.0
        if low < height < high:
            share = (height - low) / (high - low)
        up, down = value("MPC_Z_VEL_MAX_UP"), value("MPC_Z_VEL_MAX_DN")
        up_limit = value("MPC_TKO_SPEED") + share * (up - value("MPC_TKO_SPEED"))
        down_limit = value("MPC_LAND_SPEED") + share * (down - value("MPC_LAND_SPEED"))
        speed = -shaped * (up if shaped > 0.0 else down)
        return min(down_limit, max(-up_limit, speed))


class HorizontalStick:
    """Roll and pitch sticks accelerate; drag limits the speed, and stops when released."""

    def __init__(self, value: Callable[[str], float]) -> None:
        self._value = value
        self._velocity = (0.0, 0.0)
        self._acceleration = (0.0, 0.0)
        self._held = (NAN, NAN)
        self._boost = 1.0

    def restart(self, velocity: tuple[float, float]) -> None:
        """Start with a velocity NED [m/s]."""
        self._velocity, self._acceleration = velocity, (0.0, 0.0)
        self._held, self._boost = (NAN, NAN), 1.0

    def move(
        self,
        sticks: tuple[float, float],
        yaw: float,
        position: tuple[float, float],
        dt: float,
        constrain: Callable[[Pair, Pair], Pair] | None = None,
    ) -> tuple[AxisDemand, AxisDemand]:
        """Return the demands north and east from sticks (forward, right) and heading [rad].

        `constrain` returns the permitted acceleration at a velocity setpoint.
        """
        value = self._value
        speed, force = value("MPC_VEL_MANUAL"), 2.0 * value("MPC_ACC_HOR")
        north, east = self._direction(sticks, yaw)
        released = north == 0.0 and east == 0.0
        boost = max(2.0, math.sqrt(speed)) if released else 1.0
        self._boost += (boost - self._boost) * dt / (dt + _BOOST_TAU_S)
        drag = [force / speed * self._boost * v for v in self._dragged()]
        wanted = north * force, east * force
        if constrain is not None:
            wanted = constrain(wanted, self._velocity)
            released = wanted == (0.0, 0.0)
        before = self._acceleration
        reversing = any(w * b < 0.0 for w, b in zip(wanted, before, strict=True))
        if (released or reversing) and math.hypot(*self._velocity) < math.hypot(*drag) * dt:
            drag, self._velocity = [0.0, 0.0], (0.0, 0.0)
        self._acceleration = self._limited([w - d for w, d in zip(wanted, drag, strict=True)], dt)
        vn, ve = (v + a * dt for v, a in zip(self._velocity, self._acceleration, strict=True))
        if released and math.hypot(vn, ve) < 1e-3:
            vn, ve = 0.0, 0.0
        self._velocity = vn, ve
        if math.hypot(vn, ve) > 1e-3:
            self._held = NAN, NAN
        elif math.isnan(self._held[0]):
            self._held = position
        pairs = zip(self._held, self._velocity, self._acceleration, strict=True)
        first, second = (AxisDemand(p, v, a) for p, v, a in pairs)
        return first, second

    def _direction(self, sticks: tuple[float, float], yaw: float) -> tuple[float, float]:
        """Return the deflection north and east, with a norm of at most 1."""
        value = self._value
        zone, share = value("MPC_HOLD_DZ"), value("MPC_XY_MAN_EXPO")
        forward, right = (expo(deadzone(s, zone), share) for s in sticks)
        length = max(1.0, math.hypot(forward, right))
        forward, right = forward / length, right / length
        side, back = value("MPC_VEL_MAN_SIDE"), value("MPC_VEL_MAN_BACK")
        if side >= 0.0:
            right *= side / value("MPC_VEL_MANUAL")
        if back >= 0.0 and forward < 0.0:
            forward *= back / value("MPC_VEL_MANUAL")
        c, s = math.cos(yaw), math.sin(yaw)
        return c * forward - s * right, s * forward + c * right

    def _dragged(self) -> tuple[float, float]:
        """Return the velocity for the drag: increased when braking below 1 m/s, by its root."""
        vn, ve = self._velocity
        speed = math.hypot(vn, ve)
        if speed == 0.0:
            return 0.0, 0.0
        braking = min(1.0, max(0.0, self._boost - 1.0))
        share = braking * max(1.0, 1.0 / math.sqrt(speed)) + 1.0 - braking
        return vn * share, ve * share

    def _limited(self, wanted: list[float], dt: float) -> tuple[float, float]:
        """Return an acceleration with limited jerk and tilt."""
        value, (bn, be) = self._value, self._acceleration
        dn, de = wanted[0] - bn, wanted[1] - be
        step, most = math.hypot(dn, de), value("MPC_JERK_MAX") * dt
        share = 1.0 if step <= most else most / step
        north, east = bn + dn * share, be + de * share
        length = math.hypot(north, east)
        tilt = math.tan(value("MPC_TILTMAX_AIR") * DEG) * GRAVITY_M_S2
        share = 1.0 if length <= tilt else tilt / length
        return north * share, east * share
