"""Plain data of the autopilot's state for MAVLink, the recorder and tests.

Types created for every snapshot are named tuples, which are faster than dataclasses.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from enum import IntEnum
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from firmware_sim.autopilot.events.definition import Definition, Level, MavlinkEvent
from firmware_sim.autopilot.flight_modes import Mode

Vector = NDArray[np.float64]


class Arming(IntEnum):
    """Arming state."""

    BOOT = 0
    """Estimator not converged: arming is disabled."""
    STANDBY = 1
    ARMED = 2


Landed = IntEnum("Landed", "ON_GROUND TAKEOFF IN_AIR LANDING", start=0)
"""State of the landing detector."""


Severity = Level
"""MAV_SEVERITY of a STATUSTEXT: the levels of events up to DEBUG."""


@dataclass(frozen=True, slots=True)
class OperatorText:
    """Text for the operator (STATUSTEXT)."""

    severity: Severity
    text: str
    event: MavlinkEvent | None = field(default=None, compare=False)
    """Equivalent event for ground stations with event support; None = no event."""

    @classmethod
    def of(
        cls, severity: Severity, definition: Definition, *values: float, text: str | None = None
    ) -> OperatorText:
        """Return an event with its arguments and its text; None = the event's message."""
        words = definition.message if text is None else text
        return cls(severity, words, definition.event(*values))


class Result(IntEnum):
    """Command result; values are MAV_RESULT."""

    ACCEPTED = 0
    TEMPORARILY_REJECTED = 1
    DENIED = 2
    UNSUPPORTED = 3
    FAILED = 4
    CANCELLED = 6


Wire: TypeAlias = "tuple[float, float, float, float]"
"""Four numbers of an offboard setpoint exactly as received; latency analysis matches messages by
them."""

UNTOLD: Wire = (math.nan, math.nan, math.nan, math.nan)
"""Placeholder for a setpoint without a message."""


class Setpoint(NamedTuple):
    """Offboard setpoint in local NED. NaN = axis not commanded."""

    position: Vector  # (3,) NED [m]
    velocity: Vector  # (3,) NED [m/s]
    yaw: float
    """Heading [rad]."""
    yaw_rate: float
    """[rad/s], positive clockwise seen from above."""
    wire: Wire = UNTOLD
    """Velocity and yaw rate, or yaw if no rate is commanded."""
    acceleration: Vector = np.full(3, math.nan)  # (3,) NED [m/s²]


class StateEstimate(NamedTuple):
    """Output of the estimator."""

    time_us: int
    position: Vector  # (3,) local NED [m]
    velocity: Vector  # (3,) NED [m/s]
    acceleration: Vector  # (3,) NED, gravity removed [m/s²]
    quaternion: Vector  # (4,) body FRD -> NED
    angular_velocity: Vector  # (3,) FRD, bias removed [rad/s]
    gyro_bias: Vector  # (3,) [rad/s]
    accel_bias: Vector  # (3,) [m/s²]
    sigma: Vector
    """(16,) standard deviations: position, velocity, attitude (3 each), gyro bias, accelerometer
    bias (3 each), barometer offset."""
    innovation_ratio: Vector
    """(4,) newest normalised innovation (test ratio, 1 = rejection gate) of horizontal velocity
    and position (GPS), height (barometer), magnetometer, GPS height/vertical speed."""
    healthy: bool
    """True if converged: the vehicle may arm and fly."""


class Clearance(NamedTuple):
    """Estimated height above the ground (vehicle_local_position)."""

    dist_bottom_m: float
    """Height above the ground [m], not negative."""
    valid: bool
    variance_m2: float
    """Variance of the terrain height, as reported by PX4."""
    by_range: bool
    """True if the terrain height comes from ranges."""
    resets: int
    """Number of terrain height resets."""
    ratio: float
    """Mean test ratio of ranges relative to the gate; NaN = no ranges are fused."""


class CommanderStatus(NamedTuple):
    """State of the commander."""

    arming: Arming
    mode: Mode
    """Active mode. A failsafe may replace the intended one."""
    intended_mode: Mode
    landed: Landed
    failsafe: bool


MissionState = IntEnum(
    "MissionState", "UNKNOWN NO_MISSION NOT_STARTED ACTIVE PAUSED COMPLETE", start=0
)
"""State of the mission; values are MISSION_STATE."""


class MissionProgress(NamedTuple):
    """Progress of the mission."""

    current: int = 0
    """Index of the active item, or of the next item if the mission is paused."""
    total: int = 0
    """Number of items; 0 = no mission stored."""
    mission_id: int = 0
    """PX4's opaque mission id; 0 = none. The same applies to the two ids below."""
    fence_id: int = 0
    rally_points_id: int = 0
    state: MissionState = MissionState.UNKNOWN
    mode: int = 0
    """MISSION_MODE: 1 active, 2 suspended; 0 = unknown, as the state in PX4 1.16."""


class FenceStatus(NamedTuple):
    """Violated limits of the geofence, and the number of breaches."""

    distance: bool = False
    """Farther from home than GF_MAX_HOR_DIST."""
    altitude: bool = False
    """Higher above home than GF_MAX_VER_DIST."""
    custom: bool = False
    """Outside the uploaded fence, or inside an exclusion zone."""
    breaches: int = 0
    """Number of breaches since boot."""
    time_us: int = 0
    """Start time of the newest breach [µs]."""

    @property
    def breached(self) -> tuple[bool, bool, bool]:
        """Active breaches: distance, altitude, custom."""
        return self.distance, self.altitude, self.custom


class OrbitStatus(NamedTuple):
    """Circle of Orbit mode."""

    radius_m: float
    """Positive clockwise."""
    centre: tuple[float, float, float]
    """Local NED [m]."""


class Health(NamedTuple):
    """Usability of sensors and estimates, from sensor, estimator and pre-arm checks."""

    gyro: bool = True
    accel: bool = True
    mag: bool = True
    baro: bool = True
    gps: bool = True
    distance: bool | None = None
    """Flag: distance sensor healthy; None: arming does not require it, or none was connected."""
    attitude: bool = True
    velocity: bool = True
    """Horizontal velocity estimate."""
    position: bool = True
    """Horizontal position estimate."""
    altitude: bool = True
    accel_error: bool = False
    """Inertial data disagreed with GPS recently."""
    battery: bool = True
    armable: bool = True
    """No check prevents arming in the current mode."""
