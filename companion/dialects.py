"""Differences between flight controllers behind MAVSDK, hidden from the rest of the companion.

Measured with MAVSDK 4.1 on PX4 1.16 and ArduCopter 4.7, without differences hidden by MAVSDK.
Take-off and offboard use ArduCopter's GUIDED mode, leaving offboard uses its BRAKE mode. The
take-off command contains the altitude.
"""

from __future__ import annotations

from dataclasses import dataclass

from mavsdk.autopilot import Autopilot

RATE_HZ = 50.0
"""Requested rate of position, velocity and attitude [Hz]."""

_STATUS_HZ = 5.0
"""Rate of health and landed state if they must be requested [Hz]; equal to PX4's."""

_KINEMATICS = (("position_velocity_ned", RATE_HZ), ("attitude_quaternion", RATE_HZ))


@dataclass(frozen=True)
class Dialect:
    """Properties of one kind of flight controller."""

    name: str
    streams: tuple[tuple[str, float], ...]
    """Streams to request, in order: X of MAVSDK's telemetry.set_rate_X, and the rate [Hz]."""
    health: tuple[str, ...]
    """Flags of MAVSDK's health required for arming and flight by position."""
    arm_timeout_s: float
    """Timeout from the start of a mission to arming, with a flight controller just powered up
    [s]."""


POSITION = ("is_local_position_ok", "is_global_position_ok")
"""Flags of MAVSDK's health for positions."""

PX4 = Dialect(
    "PX4",
    _KINEMATICS,
    # health_all_ok without the home position: PX4 sets home when it arms, and MAVSDK discards it
    # after this process was stopped for 3 s.
    (
        "is_gyrometer_calibration_ok",
        "is_accelerometer_calibration_ok",
        "is_magnetometer_calibration_ok",
        *POSITION,
        "is_armable",
    ),
    arm_timeout_s=20.0,
)

ARDUPILOT = Dialect(
    "ArduPilot",
    # By default only heartbeats are sent (SRn_ parameters are 0); health needs several streams.
    (
        *_KINEMATICS,
        ("position", _STATUS_HZ),
        ("health", _STATUS_HZ),
        ("landed_state", _STATUS_HZ),
        ("home", 1.0),
    ),
    # STABILIZE can be armed without a position; GUIDED, and so take-off, requires a position.
    # MAVSDK's calibration flags are omitted: for ArduPilot they mean "enabled and healthy now", and
    # the pre-arm checks include the calibration.
    (*POSITION, "is_home_position_ok", "is_armable"),
    # The EKF estimates the gyro bias for 40 s before it uses GPS.
    arm_timeout_s=90.0,
)


def dialect_of(autopilot: Autopilot) -> Dialect:
    """Return the dialect of MAVSDK's kind of autopilot; unknown kinds are treated as PX4."""
    return ARDUPILOT if autopilot == Autopilot.ARDUPILOT else PX4
