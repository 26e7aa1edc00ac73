"""Failures on demand, Return, Land, and the end."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from mavsdk.plugins.failure import Failure, FailureType, FailureUnit
from mavsdk.plugins.param import Param
from mavsdk.plugins.telemetry import FlightMode

from tests.support.px4_walk.flight import action, armed, disarmed, in_mode, take_off
from tests.support.px4_walk.row import Row
from tests.support.px4_walk.vehicle import Vehicle

RETURN_M = 12.0


def _inject(unit: str, kind: str) -> Callable[[Vehicle], Any]:
    return lambda v: v.plugin(Failure).inject(FailureUnit[unit], FailureType[kind], 0)


def _failures(unit: str, expected: str = "ok", kinds: tuple[str, ...] = ("OFF", "OK")) -> Any:
    return (
        Row("failure", f"inject {unit} {kind}", _inject(unit, kind), (expected,), slow=bool(slow))
        for kind in kinds
        for slow in [expected == "TIMEOUT"]
    )


def _returned(vehicle: Vehicle) -> float:
    """Return the maximum height [m]."""
    heights = [0.0]

    def landed() -> bool:
        heights.append(vehicle.height)
        return not vehicle.telemetry.armed()

    vehicle.until(landed, 90.0)
    disarmed(vehicle, 5.0)
    return max(heights)


FAILURES = (
    Row(
        "failure",
        "set SYS_FAILURE_EN 1",
        lambda v: v.plugin(Param).set_param_int("SYS_FAILURE_EN", 1),
    ),
    # Without GPS or battery, a failsafe ends the flight within a second.
    *_failures("SENSOR_GPS", kinds=("OK",)),
    *_failures("SYSTEM_BATTERY", kinds=("OK",)),
    *_failures("SENSOR_MAG"),
    *_failures("SENSOR_BARO"),
    *_failures("SYSTEM_RC_SIGNAL", "TIMEOUT"),
    *_failures("SYSTEM_MAVLINK_SIGNAL", "TIMEOUT"),
    Row("failure", "hold after the failures", lambda v: action(v).hold()),
    Row("failure", "... mode", in_mode(FlightMode.HOLD)),
)
"""Before the pilot's sticks: once those were heard and have gone, the vehicle returns after 5 s
(COM_FAIL_ACT_T, NAV_RCL_ACT), and calls that time out take longer."""

ROWS = (
    Row(
        "rtl",
        "set_return_to_launch_altitude",
        lambda v: action(v).set_return_to_launch_altitude(RETURN_M),
    ),
    Row("rtl", "return_to_launch", lambda v: action(v).return_to_launch()),
    Row("rtl", "... mode", in_mode(FlightMode.RETURN_TO_LAUNCH)),
    Row("rtl", "landed and disarmed", _returned, check=lambda m: abs(m - RETURN_M) < 1.0),
    Row("rtl", "... mode afterwards", in_mode(FlightMode.HOLD)),
    Row("land", "arm", armed),
    Row("land", "take-off", take_off),
    Row("land", "land", lambda v: action(v).land()),
    Row("land", "... mode", in_mode(FlightMode.LAND)),
    Row("land", "landed and disarmed", lambda v: disarmed(v, 60.0)),
    Row("end", "arm", armed),
    Row("end", "kill", lambda v: action(v).kill()),
    Row("end", "... disarmed", lambda v: v.until(lambda: not v.telemetry.armed(), 3.0)),
    Row("end", "terminate disarmed", lambda v: action(v).terminate(), ("COMMAND_DENIED",)),
)
