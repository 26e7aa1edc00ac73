"""State of the autopilot: plain data for MAVLink, the recorder and tests.

Whatever is created for every snapshot is a named tuple, which is faster than a dataclass.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from enum import IntEnum
from typing import NamedTuple, Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

from airl_mav.core.frames import Geodetic
from firmware_sim.autopilot.events.definition import Definition, Event
from firmware_sim.autopilot.manual_control import Sticks
from firmware_sim.interfaces import (
    BatterySample,
    DistanceReading,
    FlowReading,
    GpsFix,
    Odometry,
)

Vector = NDArray[np.float64]


class Arming(IntEnum):
    """Arming state."""

    BOOT = 0
    """Estimator not yet converged: cannot arm."""
    STANDBY = 1
    ARMED = 2


class Mode(IntEnum):
    """Flight modes."""

    HOLD = 0
    TAKEOFF = 1
    OFFBOARD = 2
    LAND = 3
    RETURN = 4
    POSITION = 5
    """Needs a pilot's input, as the other modes with sticks. Without it PX4 was measured to brake
    and to descend to the ground: the offboard-loss fallback."""
    MISSION = 6
    MANUAL = 7
    """As Stabilized, for a multicopter."""
    STABILIZED = 8
    ACRO = 9
    ALTITUDE = 10
    ORBIT = 11
    FOLLOW = 12
    DESCEND = 13
    """Comes down level without knowing where; failsafes alone choose it."""
    TERMINATION = 14
    """The motors stand still for good."""
    PRECISION_LAND = 15
    """Onto a landing target that is reported."""


MODE_NAMES = {
    Mode.HOLD: "Hold",
    Mode.TAKEOFF: "Takeoff",
    Mode.OFFBOARD: "Offboard",
    Mode.LAND: "Land",
    Mode.RETURN: "Return",
    Mode.POSITION: "Position",
    Mode.MISSION: "Mission",
    Mode.MANUAL: "Manual",
    Mode.STABILIZED: "Stabilized",
    Mode.ACRO: "Acro",
    Mode.ALTITUDE: "Altitude",
    Mode.ORBIT: "Orbit",
    Mode.FOLLOW: "Follow Target",
    Mode.DESCEND: "Descend",
    Mode.TERMINATION: "Termination",
    Mode.PRECISION_LAND: "Precision Landing",
}
"""As PX4's texts name them."""


WITH_STICKS = frozenset({Mode.POSITION, Mode.MANUAL, Mode.STABILIZED, Mode.ACRO, Mode.ALTITUDE})
"""Modes that need a pilot's input."""


class Landed(IntEnum):
    """Landing detector."""

    ON_GROUND = 0
    TAKEOFF = 1
    IN_AIR = 2
    LANDING = 3


class Severity(IntEnum):
    """MAV_SEVERITY of a STATUSTEXT."""

    EMERGENCY = 0
    ALERT = 1
    CRITICAL = 2
    ERROR = 3
    WARNING = 4
    NOTICE = 5
    INFO = 6
    DEBUG = 7


@dataclass(frozen=True, slots=True)
class Message:
    """A text for the operator (STATUSTEXT)."""

    severity: Severity
    text: str
    event: Event | None = field(default=None, compare=False)
    """The same as an event, for ground stations that know it; None = there is none."""

    @classmethod
    def of(
        cls, severity: Severity, definition: Definition, *values: float, text: str | None = None
    ) -> Message:
        """Return an event with its arguments, and its text; None = the words of the event."""
        words = definition.message if text is None else text
        return cls(severity, words, definition.event(*values))


class Result(IntEnum):
    """Answer to a command; the numbers are MAV_RESULT."""

    ACCEPTED = 0
    TEMPORARILY_REJECTED = 1
    DENIED = 2
    UNSUPPORTED = 3
    FAILED = 4
    CANCELLED = 6


Wire: TypeAlias = "tuple[float, float, float, float]"
"""Four numbers of an offboard setpoint exactly as received: what latency analysis recognises a
message by."""

UNTOLD: Wire = (math.nan, math.nan, math.nan, math.nan)
"""Of a setpoint that no message brought."""


class Setpoint(NamedTuple):
    """An offboard setpoint, already in local NED. NaN = not commanded on that axis."""

    position: Vector  # (3,) NED [m]
    velocity: Vector  # (3,) NED [m/s]
    yaw: float
    """Heading [rad]."""
    yaw_rate: float
    """[rad/s], positive clockwise seen from above."""
    wire: Wire = UNTOLD
    """Velocity and yaw rate (or yaw, where no rate is commanded)."""
    acceleration: Vector = np.full(3, math.nan)  # (3,) NED [m/s²]


class Estimate(NamedTuple):
    """The estimator's output."""

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
    """Converged: may be armed and flown on."""


class Clearance(NamedTuple):
    """Estimated height above the ground (vehicle_local_position)."""

    dist_bottom_m: float
    """Not negative."""
    valid: bool
    variance_m2: float
    """Of where the ground is, as PX4 reports it."""
    by_range: bool
    """Whether ranges say where the ground is."""
    resets: int
    """How often the ground has been put elsewhere."""
    ratio: float
    """Mean test ratio of ranges, as a share of the gate; NaN = none are fused."""


class CommanderStatus(NamedTuple):
    """State of the commander."""

    arming: Arming
    mode: Mode
    """Active mode. A failsafe may replace the intended one."""
    intended_mode: Mode
    landed: Landed
    failsafe: bool


class MissionProgress(NamedTuple):
    """Progress of the mission."""

    current: int = 0
    """Index of the item that is flown, or will be when the mission goes on."""
    total: int = 0
    """Number of items; 0 = no mission is stored."""
    mission_id: int = 0
    """PX4's opaque id of the mission; 0 = none, as of the two below."""
    fence_id: int = 0
    rally_points_id: int = 0


NO_MISSION = MissionProgress()


class FenceStatus(NamedTuple):
    """Violated limits of the geofence, and the number of breaches."""

    distance: bool = False
    """Farther from home than GF_MAX_HOR_DIST."""
    altitude: bool = False
    """Higher above home than GF_MAX_VER_DIST."""
    custom: bool = False
    """Outside the uploaded fence, or inside what it excludes."""
    breaches: int = 0
    """How many there were since boot."""
    time_us: int = 0
    """When the newest breach began [µs]."""

    @property
    def breached(self) -> tuple[bool, bool, bool]:
        """Present breaches: distance, altitude, custom."""
        return self.distance, self.altitude, self.custom


class OrbitStatus(NamedTuple):
    """The circle that Orbit mode flies."""

    radius_m: float
    """Positive clockwise."""
    centre: tuple[float, float, float]
    """Local NED [m]."""


class Health(NamedTuple):
    """What can be believed and used, as sensors, estimator and pre-arm checks have it."""

    gyro: bool = True
    accel: bool = True
    mag: bool = True
    baro: bool = True
    gps: bool = True
    distance: bool | None = None
    """None: arming asks for no distance sensor, or there never was one."""
    attitude: bool = True
    velocity: bool = True
    """Horizontal, of the estimate."""
    position: bool = True
    """Horizontal, of the estimate."""
    altitude: bool = True
    accel_error: bool = False
    """Inertial data disagreed with the GPS lately."""
    battery: bool = True
    armable: bool = True
    """No check keeps the vehicle from arming in its mode."""


class AutopilotState(Protocol):
    """The autopilot after its newest tick, for whoever speaks for it; valid until the next one.

    Implementations compute a property when it is read: most ticks need a few of them.
    """

    @property
    def time_us(self) -> int:
        """Simulated time of the tick [µs]."""

    @property
    def revision(self) -> object:
        """The same object as long as nothing has changed that a tick's log lacks; None = it may."""

    @property
    def estimate(self) -> Estimate:
        """The estimator's output."""

    @property
    def status(self) -> CommanderStatus:
        """State of the commander."""

    @property
    def setpoint(self) -> Setpoint:
        """Setpoint that the controller tracks, in every mode."""

    @property
    def attitude_setpoint(self) -> Vector:
        """(4,) body -> NED."""

    @property
    def rate_setpoint(self) -> Vector:
        """(3,) FRD [rad/s]."""

    @property
    def thrust_setpoint(self) -> float:
        """Collective, 0..1."""

    @property
    def motors(self) -> tuple[float, float, float, float]:
        """Commands of the motors, 0..1."""

    @property
    def accel(self) -> Vector:
        """(3,) newest raw sample, FRD [m/s²]."""

    @property
    def gyro(self) -> Vector:
        """(3,) newest raw sample, FRD [rad/s]."""

    @property
    def mag(self) -> Vector:
        """(3,) newest raw sample, FRD [gauss]."""

    @property
    def pressure_hpa(self) -> float:
        """Newest static pressure [hPa]."""

    @property
    def temperature_c(self) -> float:
        """Air temperature [°C]."""

    @property
    def battery(self) -> BatterySample:
        """Report of the power module."""

    @property
    def gps(self) -> GpsFix | None:
        """Newest fix; None before the first."""

    @property
    def home(self) -> Geodetic | None:
        """Set when the estimator's origin is set and at arming; None before."""

    @property
    def origin(self) -> Geodetic | None:
        """The point of the globe where local NED is zero; None before the first fix."""

    @property
    def load(self) -> float:
        """Share of the tick spent computing, 0..1."""

    @property
    def armed_us(self) -> int:
        """Time of arming [µs], 0 while disarmed."""

    @property
    def takeoff_us(self) -> int:
        """Time of take-off [µs], 0 before."""

    @property
    def mission(self) -> MissionProgress:
        """Progress of the mission."""

    @property
    def fence(self) -> FenceStatus:
        """Violated limits of the geofence."""

    @property
    def orbit(self) -> OrbitStatus | None:
        """The circle that is flown, in Orbit mode."""

    @property
    def health(self) -> Health:
        """What can be believed and used."""

    @property
    def hover_thrust(self) -> float:
        """Collective that hovers, 0..1."""

    @property
    def destination(self) -> tuple[float, float, float] | None:
        """Destination of an automatic mode, local NED [m]; None in other modes."""

    @property
    def home_yaw(self) -> float:
        """Heading at home [rad]."""

    @property
    def sticks(self) -> Sticks | None:
        """A pilot's; None = none are heard."""

    @property
    def esc_outputs(self) -> tuple[float, float, float, float] | None:
        """What the speed controllers report that their motors do; None: what they are told."""

    @property
    def odometry(self) -> Odometry | None:
        """The newest pose that something else has estimated; None before any."""

    @property
    def odometry_us(self) -> int:
        """Time of its arrival [µs]."""

    @property
    def distance(self) -> DistanceReading | None:
        """The newest of a distance sensor; None before any."""

    @property
    def distance_us(self) -> int:
        """Time of its arrival [µs]."""

    @property
    def flow(self) -> FlowReading | None:
        """The newest of an optical flow sensor; None before any."""

    @property
    def flow_us(self) -> int:
        """Time of its arrival [µs]."""

    @property
    def clearance(self) -> Clearance | None:
        """Height above the ground; None before the first range."""
