"""Offboard, with every kind of setpoint that MAVSDK has."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from mavsdk.plugins.offboard import (
    AccelerationNed,
    Attitude,
    AttitudeRate,
    Offboard,
    PositionGlobalYaw,
    PositionNedYaw,
    VelocityBodyYawspeed,
    VelocityNedYaw,
)
from mavsdk.plugins.telemetry import FlightMode

from tests.support.px4_walk.flight import HEIGHT_M, in_mode
from tests.support.px4_walk.row import Row
from tests.support.px4_walk.vehicle import OFFBOARD, Vehicle

AREA = "offboard"
Moved = tuple[float, float, float, float]
"""Metres north, east, down, and degrees turned."""

_STILL = VelocityNedYaw(0.0, 0.0, 0.0, 0.0)


def offboard(vehicle: Vehicle) -> Offboard:
    """MAVSDK's offboard."""
    return vehicle.plugin(Offboard)


def fly(call: Callable[[Offboard], Any], seconds: float) -> Callable[[Vehicle], Moved]:
    """Set a setpoint; return how far the vehicle has moved and turned after some time."""

    def make(vehicle: Vehicle) -> Moved:
        begun, yaw = vehicle.position, vehicle.yaw_deg
        call(offboard(vehicle))
        vehicle.wait(seconds, speed=OFFBOARD)
        if vehicle.mode != FlightMode.OFFBOARD:
            raise AssertionError(vehicle.mode)
        north, east, down = (b - a for a, b in zip(begun, vehicle.position, strict=True))
        return north, east, down, (vehicle.yaw_deg - yaw + 180.0) % 360.0 - 180.0

    return make


def _about(*expected: float, within: float = 0.9) -> Callable[[Moved], bool]:
    """Return a check that the vehicle moved by about `expected`; NaN = any."""

    def check(moved: Moved) -> bool:
        pairs = zip(moved, expected, strict=False)
        return all(math.isnan(e) or abs(m - e) < within for m, e in pairs)

    return check


def _still(vehicle: Vehicle) -> None:
    offboard(vehicle).set_velocity_ned(_STILL)

    def rests() -> bool:
        return max(map(abs, vehicle.velocity)) < 0.25 and abs(vehicle.yaw_deg) < 3.0

    vehicle.until(rests, 10.0, speed=OFFBOARD)


def _home(vehicle: Vehicle) -> None:
    offboard(vehicle).set_position_ned(PositionNedYaw(0.0, 0.0, -HEIGHT_M, 0.0))
    vehicle.until(lambda: vehicle.is_near(0.0, 0.0, 0.5), 20.0, speed=OFFBOARD)


def _globally(vehicle: Vehicle) -> None:
    latitude, longitude = vehicle.place(4.0, 3.0)
    altitude = vehicle.telemetry.home().absolute_altitude_m + HEIGHT_M
    kind = PositionGlobalYaw.AltitudeType.AMSL
    setpoint = PositionGlobalYaw(latitude, longitude, altitude, 0.0, kind)
    offboard(vehicle).set_position_global(setpoint)
    vehicle.until(lambda: vehicle.is_near(4.0, 3.0, 0.7), 15.0, speed=OFFBOARD)


def _velocity(north: float, down: float) -> Callable[[Offboard], Any]:
    return lambda o: o.set_velocity_ned(VelocityNedYaw(north, 0.0, down, 0.0))


def _body(forward: float, turning: float) -> Callable[[Offboard], Any]:
    return lambda o: o.set_velocity_body(VelocityBodyYawspeed(forward, 0.0, 0.0, turning))


_HOVER = 0.72
"""Collective at which the quadrotor neither climbs nor sinks much in a second."""

ROWS = (
    Row(
        AREA,
        "start without setpoint (air)",
        lambda v: offboard(v).start(),
        ("NO_SETPOINT_SET",),
    ),
    Row(AREA, "set_velocity_ned", lambda v: offboard(v).set_velocity_ned(_STILL)),
    Row(AREA, "start with a velocity setpoint", lambda v: offboard(v).start()),
    Row(AREA, "... mode", in_mode(FlightMode.OFFBOARD)),
    Row(AREA, "is_active", lambda v: offboard(v).is_active(), check=bool),
    Row(AREA, "heading 0", _still),
    Row(AREA, "velocity_ned north 1", fly(_velocity(1.0, 0.0), 2.0), check=_about(1.4, 0.0, 0.0)),
    Row(AREA, "velocity_ned up 1", fly(_velocity(0.0, -1.0), 2.0), check=_about(0.6, 0.0, -1.7)),
    Row(AREA, "velocity_ned down 1", fly(_velocity(0.0, 1.0), 2.0), check=_about(0.0, 0.0, 1.4)),
    Row(
        AREA,
        "velocity_body forward 1.5",
        fly(_body(1.5, 0.0), 3.0),
        check=_about(3.6, 0.0, 0.2, 0.0),
    ),
    Row(
        AREA,
        "velocity_body yawspeed 30",
        fly(_body(0.0, 30.0), 2.0),
        check=_about(math.nan, 0.0, 0.0, 60.0, within=30.0),
    ),
    Row(AREA, "position_ned", _home),
    Row(AREA, "position_global", _globally),
    Row(AREA, "velocity 0", _still),
    Row(
        AREA,
        "acceleration_ned 1 N",
        fly(lambda o: o.set_acceleration_ned(AccelerationNed(1.0, 0.0, 0.0)), 1.5),
        check=_about(0.8, 0.0, 0.0, within=0.6),
    ),
    Row(AREA, "velocity 0 after the acceleration", _still),
    Row(
        AREA,
        "attitude pitch -10",
        fly(lambda o: o.set_attitude(Attitude(0.0, -10.0, 0.0, _HOVER)), 1.0),
        check=lambda moved: moved[0] > 0.05,
    ),
    Row(AREA, "velocity 0 after the attitude", _still),
    Row(
        AREA,
        "attitude_rate yaw 40",
        fly(lambda o: o.set_attitude_rate(AttitudeRate(0.0, 0.0, 40.0, _HOVER)), 1.0),
        check=lambda moved: 15.0 < moved[3] < 50.0,
    ),
    Row(AREA, "velocity 0 after the rate", _still),
    Row(AREA, "stop", lambda v: offboard(v).stop()),
    Row(AREA, "... mode after the stop", in_mode(FlightMode.HOLD)),
)
