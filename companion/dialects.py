"""How flight controllers differ behind MAVSDK: all else in the companion knows one kind only.

Measured with MAVSDK 4.1 on PX4 1.16 and ArduCopter 4.7. What MAVSDK itself levels out is not here:
take-off and offboard fly in ArduCopter's GUIDED mode, leaving offboard is its BRAKE mode, and the
altitude of a take-off travels with the command.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

from mavsdk.autopilot import Autopilot

RATE_HZ = 50.0
"""Rate asked for position, velocity and attitude [Hz]."""

_STATUS_HZ = 5.0
"""Rate asked for health and landed state, where they do not come unasked [Hz]; as PX4's."""

_KINEMATICS = (("position_velocity_ned", RATE_HZ), ("attitude_quaternion", RATE_HZ))


@dataclass(frozen=True)
class Dialect:
    """What one kind of flight controller needs."""

    name: str
    streams: tuple[tuple[str, float], ...]
    """What must be asked for: X of MAVSDK's telemetry.set_rate_X, and the rate [Hz]."""
    ready: Callable[[Any], bool]
    """Whether it may be armed and then flown by position, by MAVSDK's telemetry."""
    arm_timeout_s: float
    """Longest time from the beginning of a mission, with the flight controller just powered up, to
    its arming [s]."""

    def requests(self, telemetry: Any) -> list[Callable[[], Any]]:
        """Return what asks MAVSDK's telemetry for the streams, one after the other."""
        return [partial(getattr(telemetry, f"set_rate_{name}"), hz) for name, hz in self.streams]


def _px4_ready(telemetry: Any) -> bool:
    return bool(telemetry.health_all_ok() and telemetry.health().is_armable)


def _ardupilot_ready(telemetry: Any) -> bool:
    """In STABILIZE it may be armed without a position; GUIDED, and so take-off, needs one.

    MAVSDK's calibration flags are left out: they mean "enabled and healthy now" here, and the
    pre-arm checks have looked at the calibration.
    """
    health = telemetry.health()
    return bool(
        health.is_armable
        and health.is_local_position_ok
        and health.is_global_position_ok
        and health.is_home_position_ok
    )


PX4 = Dialect("PX4", _KINEMATICS, _px4_ready, arm_timeout_s=20.0)

ARDUPILOT = Dialect(
    "ArduPilot",
    # Nothing but heartbeats comes unasked (SRn_ parameters are 0), and health is made of several.
    (
        *_KINEMATICS,
        ("position", _STATUS_HZ),
        ("health", _STATUS_HZ),
        ("landed_state", _STATUS_HZ),
        ("home", 1.0),
    ),
    _ardupilot_ready,
    # Its EKF learns the gyros' bias for 40 s before it uses GPS.
    arm_timeout_s=90.0,
)


def dialect_of(autopilot: Autopilot) -> Dialect:
    """Return the dialect of MAVSDK's kind of autopilot; any unknown one is taken for PX4."""
    return ARDUPILOT if autopilot == Autopilot.ARDUPILOT else PX4
