"""A target that is followed, and the pilot's sticks."""

from __future__ import annotations

import math
from collections.abc import Callable

from mavsdk.plugins.action import Action
from mavsdk.plugins.follow_me import FollowMe, TargetLocation
from mavsdk.plugins.manual_control import ManualControl
from mavsdk.plugins.telemetry import FlightMode

from tests.support.px4_walk.flight import HEIGHT_M, in_mode
from tests.support.px4_walk.row import Row
from tests.support.px4_walk.vehicle import OFFBOARD, Vehicle

CENTRE = (0.0, 0.0, 0.5, 0.0)
"""Forward, right, thrust, yaw."""


def _sticks(vehicle: Vehicle) -> ManualControl:
    return vehicle.plugin(ManualControl)


def _held(sticks: tuple[float, float, float, float], seconds: float) -> Callable[[Vehicle], float]:
    """Hold the sticks for some time; return how far the vehicle came [m]."""

    def make(vehicle: Vehicle) -> float:
        begun = vehicle.position
        vehicle.wait(
            seconds, lambda: _sticks(vehicle).set_manual_control_input(*sticks), speed=OFFBOARD
        )
        return math.dist(vehicle.position, begun)

    return make


def _turned(vehicle: Vehicle) -> float:
    before = vehicle.yaw_deg
    _held((0.0, 0.0, 0.5, 0.4), 2.0)(vehicle)
    return abs((vehicle.yaw_deg - before + 180.0) % 360.0 - 180.0)


def _start(vehicle: Vehicle) -> None:
    _held(CENTRE, 0.5)(vehicle)
    _sticks(vehicle).start_position_control()
    _held(CENTRE, 1.5)(vehicle)
    if vehicle.mode != FlightMode.POSCTL:
        raise AssertionError(vehicle.mode)


def _follow(vehicle: Vehicle) -> FollowMe:
    return vehicle.plugin(FollowMe)


def _target(vehicle: Vehicle) -> None:
    latitude, longitude = vehicle.place(10.0, 10.0)
    altitude = vehicle.telemetry.home().absolute_altitude_m + HEIGHT_M
    _follow(vehicle).set_target_location(
        TargetLocation(latitude, longitude, altitude, 0.0, 0.0, 0.0)
    )


ROWS = (
    Row("follow", "set_target_location", _target, ("NOT_ACTIVE",)),
    Row("follow", "start", lambda v: _follow(v).start()),
    Row("follow", "... mode", in_mode(FlightMode.FOLLOW_ME)),
    Row("follow", "set_target_location while active", _target),
    Row("follow", "stop", lambda v: _follow(v).stop()),
    Row("follow", "hold", lambda v: v.plugin(Action).hold()),
    # The pilot comes last: once heard and gone, PX4 returns (NAV_RCL_ACT).
    Row("manual", "set_manual_control_input", _held(CENTRE, 0.5)),
    Row("manual", "start_position_control", _start),
    Row(
        "manual",
        "stick forward .5 for 3 s",
        _held((0.5, 0.0, 0.5, 0.0), 3.0),
        check=lambda moved: 0.1 < moved < 10.0,
    ),
    Row("manual", "yaw stick", _turned, check=lambda turned: 20.0 < turned < 130.0),
    Row("manual", "hold after the sticks", lambda v: v.plugin(Action).hold()),
    Row("manual", "... mode of hold", in_mode(FlightMode.HOLD)),
)
