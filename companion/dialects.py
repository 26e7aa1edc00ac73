"""How flight controllers differ behind MAVSDK; the rest of the companion knows one kind only.

Measured with MAVSDK 4.1 on PX4 1.16 and ArduCopter 4.7. What MAVSDK itself hides is not here.
Take-off and offboard fly in ArduCopter's GUIDED mode, leaving offboard is its BRAKE mode. The
altitude of a take-off travels with the command.
"""

from __future__ import annotations

from dataclasses import dataclass

from mavsdk.autopilot import Autopilot

RATE_HZ = 50.0
"""Rate asked for position, velocity and attitude [Hz]."""

_STATUS_HZ = 5.0
"""Rate of health and landed state where they must be requested [Hz]; as PX4's."""

_KINEMATICS = (("position_velocity_ned", RATE_HZ), ("attitude_quaternion", RATE_HZ))


@dataclass(frozen=True)
class Dialect:
    """What is particular to one kind of flight controller."""

    name: str
    streams: tuple[tuple[str, float], ...]
    """Streams to request, in order: X of MAVSDK's telemetry.set_rate_X, and the rate [Hz]."""
    health: tuple[str, ...]
    """Flags of MAVSDK's health that must be set for arming and flight by position."""
    arm_timeout_s: float
    """Longest time from the beginning of a mission, with the flight controller just powered up, to
    its arming [s]."""


POSITION = ("is_local_position_ok", "is_global_position_ok")
"""Flags of MAVSDK's health that are about positions."""

PX4 = Dialect(
    "PX4",
    _KINEMATICS,
    # health_all_ok without the home position: PX4 sets home when it arms, and MAVSDK forgets it
    # whenever this process has stood still for 3 s.
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
    # Only heartbeats are sent unasked (SRn_ parameters are 0), and health needs several streams.
    (
        *_KINEMATICS,
        ("position", _STATUS_HZ),
        ("health", _STATUS_HZ),
        ("landed_state", _STATUS_HZ),
        ("home", 1.0),
    ),
    # In STABILIZE it may be armed without a position; GUIDED, and so take-off, needs one. MAVSDK's
    # calibration flags are left out: they mean "enabled and healthy now" here, and the pre-arm
    # checks have looked at the calibration.
    (*POSITION, "is_home_position_ok", "is_armable"),
    # Its EKF learns the gyros' bias for 40 s before it uses GPS.
    arm_timeout_s=90.0,
)


def dialect_of(autopilot: Autopilot) -> Dialect:
    """Return the dialect of MAVSDK's kind of autopilot; unknown kinds are treated as PX4."""
    return ARDUPILOT if autopilot == Autopilot.ARDUPILOT else PX4
