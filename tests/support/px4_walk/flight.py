"""Arming, take-off, and the actions of a vehicle in the air."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from mavsdk.plugins.action import Action, OrbitYawBehavior
from mavsdk.plugins.offboard import Offboard
from mavsdk.plugins.param import Param
from mavsdk.plugins.telemetry import FlightMode, LandedState

from tests.support.px4_walk.row import Row
from tests.support.px4_walk.vehicle import Vehicle

HEIGHT_M = 8.0
"""Take-off height above home."""

ORBIT_M, ORBIT_M_S = 8.0, 3.0
SLOW_M_S = 2.0


def action(vehicle: Vehicle) -> Action:
    """MAVSDK's actions."""
    return vehicle.plugin(Action)


def in_mode(mode: FlightMode, limit_s: float = 5.0) -> Callable[[Vehicle], None]:
    """Wait for a mode."""
    return lambda v: v.until(lambda: v.mode == mode, limit_s)


def ready(vehicle: Vehicle) -> None:
    """Hold on the ground, ready to arm."""
    action(vehicle).hold()
    vehicle.until(lambda: vehicle.telemetry.health().is_armable, 30.0)


def armed(vehicle: Vehicle) -> None:
    """Arm; the vehicle says so."""
    action(vehicle).arm()
    vehicle.until(vehicle.telemetry.armed, 3.0)


def take_off(vehicle: Vehicle) -> None:
    """Take off, and reach the altitude in Hold."""
    action(vehicle).set_takeoff_altitude(HEIGHT_M)
    action(vehicle).takeoff()
    vehicle.until(lambda: vehicle.mode == FlightMode.TAKEOFF, 3.0)
    vehicle.until(lambda: vehicle.mode == FlightMode.HOLD, 40.0)
    vehicle.until(lambda: vehicle.height > HEIGHT_M - 0.6, 10.0)


def disarmed(vehicle: Vehicle, limit_s: float) -> None:
    """Wait until it has landed and disarmed."""
    vehicle.until(
        lambda: (
            vehicle.telemetry.landed_state() == LandedState.ON_GROUND
            and not vehicle.telemetry.armed()
        ),
        limit_s,
    )


def go_to(north: float, east: float, yaw_deg: float) -> Callable[[Vehicle], None]:
    """Fly to a place, 2 m above the altitude of the take-off."""

    def make(vehicle: Vehicle) -> None:
        latitude, longitude = vehicle.place(north, east)
        altitude = vehicle.telemetry.home().absolute_altitude_m + HEIGHT_M + 2.0
        action(vehicle).goto_location(latitude, longitude, altitude, yaw_deg)

    return make


def _arrived(north: float, east: float, yaw_deg: float) -> Callable[[Vehicle], float]:
    """Return the highest speed on the way."""

    def make(vehicle: Vehicle) -> float:
        speeds = [0.0]

        def there() -> bool:
            speeds.append(math.hypot(*vehicle.velocity[:2]))
            turned = abs((vehicle.yaw_deg - yaw_deg + 180.0) % 360.0 - 180.0) < 5.0
            return vehicle.is_near(north, east) and turned

        vehicle.until(there, 30.0)
        if vehicle.mode != FlightMode.HOLD:
            raise AssertionError(vehicle.mode)
        return max(speeds)

    return make


def _orbit(vehicle: Vehicle) -> None:
    latitude, longitude = vehicle.place(0.0, 0.0)
    altitude = vehicle.telemetry.home().absolute_altitude_m + HEIGHT_M + 2.0
    behaviour = OrbitYawBehavior.HOLD_FRONT_TO_CIRCLE_CENTER
    action(vehicle).do_orbit(ORBIT_M, ORBIT_M_S, behaviour, latitude, longitude, altitude)


def _orbiting(vehicle: Vehicle) -> tuple[float, float]:
    """Return radius [m] and speed [m/s], once it is on the circle."""
    vehicle.until(lambda: abs(math.hypot(*vehicle.position[:2]) - ORBIT_M) < 0.8, 20.0)
    vehicle.wait(5.0)
    return math.hypot(*vehicle.position[:2]), math.hypot(*vehicle.velocity[:2])


def _disarm_denied(vehicle: Vehicle) -> Any:
    return action(vehicle).disarm()


GROUND = (
    # MAVSDK repeats setpoints by the wall clock, simulated time may be much faster.
    Row("arm", "COM_OF_LOSS_T 5", lambda v: v.plugin(Param).set_param_float("COM_OF_LOSS_T", 5.0)),
    Row("arm", "hold before arming", ready),
    Row(
        "arm",
        "offboard.start without setpoint (ground)",
        lambda v: v.plugin(Offboard).start(),
        ("NO_SETPOINT_SET",),
    ),
    Row("arm", "arm", armed),
    Row("arm", "arm again", lambda v: action(v).arm()),
    Row("arm", "disarm on the ground", lambda v: action(v).disarm()),
    Row("arm", "... disarmed", lambda v: v.until(lambda: not v.telemetry.armed(), 3.0)),
    Row("arm", "return disarmed", lambda v: action(v).return_to_launch()),
    Row("arm", "arm in Return", lambda v: action(v).arm(), ("COMMAND_DENIED",)),
    Row("arm", "land disarmed", lambda v: action(v).land()),
    Row("arm", "arm in Land", lambda v: action(v).arm(), ("COMMAND_DENIED",)),
    Row("arm", "hold again", ready),
)

CLIMB = (
    Row("arm", "arm for the flight", armed),
    Row("arm", "take-off", take_off),
    Row("arm", "disarm in the air", _disarm_denied, ("COMMAND_DENIED",)),
)

AIR = (
    Row("action", "goto_location 12N 6E", go_to(12.0, 6.0, 90.0)),
    Row("action", "... arrived", _arrived(12.0, 6.0, 90.0), check=lambda v: 2.5 < v < 5.6),
    Row("action", "set_current_speed 2", lambda v: action(v).set_current_speed(SLOW_M_S)),
    Row("action", "goto_location 2N 6E", go_to(2.0, 6.0, 0.0)),
    Row("action", "... arrived at 2 m/s", _arrived(2.0, 6.0, 0.0), check=lambda v: v < 2.4),
    Row("action", "set_current_speed 5", lambda v: action(v).set_current_speed(5.0)),
    Row("action", "hold", lambda v: action(v).hold()),
    Row("action", "do_orbit", _orbit),
    # PX4 1.16 reports an orbit as Position.
    Row("action", "... mode", in_mode(FlightMode.POSCTL)),
    Row(
        "action",
        "... radius and speed",
        _orbiting,
        check=lambda v: abs(v[0] - ORBIT_M) < 0.8 and abs(v[1] - ORBIT_M_S) < 0.4,
    ),
    Row("action", "hold after the orbit", lambda v: action(v).hold()),
    Row("action", "... mode of hold", in_mode(FlightMode.HOLD)),
)
