"""Interface between plant and autopilot: PX4's simulator interface as plain data.

A plant turns motor commands into sensor samples; an autopilot turns sensor samples into motor
commands. Real firmware uses the same two messages (HIL_SENSOR / HIL_ACTUATOR_CONTROLS).

All types are named tuples: they are faster to create than dataclasses, which matters at 250 Hz and
a hundred times real time.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, Protocol

import numpy as np

from airl_mav.core import errors, frames

if TYPE_CHECKING:
    from firmware_sim.autopilot.autopilot import BuiltinAutopilot
    from firmware_sim.autopilot.autopilot_state import OperatorText
    from firmware_sim.autopilot.commander import CommanderState
    from firmware_sim.plant.body import PlantBody

ULOG_SUFFIX = ".ulg"
"""Suffix of PX4's flight logs."""

UNKNOWN_VARIANCE = np.full(3, np.nan)
UNKNOWN_VARIANCE.setflags(write=False)

PoseFrame = Literal["ned", "frd"]
"""Reference frame of a pose: north, east, down; or forward, right, down at the start, with an
unknown heading."""

DOWNWARD = 25
"""MAV_SENSOR_ROTATION_PITCH_270: downward distance sensor."""

VelocityFrame = Literal["ned", "frd", "body"]
"""Reference frame of a velocity: a pose frame, or the vehicle's body axes FRD."""


class GpsFix(NamedTuple):
    """GPS solution."""

    position: frames.Geodetic
    velocity_ned: frames.Vector  # (3,) [m/s]
    eph_m: float
    """Horizontal standard deviation [m]."""
    epv_m: float
    """Vertical standard deviation [m]."""
    satellites: int
    fix_type: int = 3
    """GPS_FIX_TYPE: 3 = 3-D fix."""


class Odometry(NamedTuple):
    """External pose estimate, from vision or motion capture.

    Fields follow PX4's vehicle_odometry. None = not measured; a variance that is not finite is
    unknown.
    """

    position: frames.Vector | None = None  # (3,) in the pose's frame [m]
    velocity: frames.Vector | None = None  # (3,) in the velocity's frame [m/s]
    quaternion: frames.Vector | None = None  # (4,) body FRD -> the pose's frame, of length 1
    pose_frame: PoseFrame = "ned"
    velocity_frame: VelocityFrame = "ned"
    position_variance: frames.Vector = UNKNOWN_VARIANCE  # (3,) [m²]
    velocity_variance: frames.Vector = UNKNOWN_VARIANCE  # (3,) [m²/s²]
    orientation_variance: frames.Vector = UNKNOWN_VARIANCE  # (3,) roll, pitch, yaw [rad²]
    reset_counter: int = 0
    """Counter of resets; a change marks a jump of the estimate."""
    quality: int = 0
    """Quality [%]; 0 = not reported."""


class DistanceReading(NamedTuple):
    """Range of a distance sensor. Fields follow PX4's distance_sensor."""

    distance_m: float
    least_m: float
    """Minimum range [m]."""
    greatest_m: float
    """Maximum range [m]."""
    variance_m2: float = 0.0
    """Variance [m²]; 0 = not reported."""
    quality: int = -1
    """Quality [%]; 0 = invalid, -1 = not reported."""
    orientation: int = DOWNWARD
    """MAV_SENSOR_ORIENTATION."""
    kind: int = 0
    """MAV_DISTANCE_SENSOR: 0 = laser."""


class FlowReading(NamedTuple):
    """Optical flow of the ground since the previous reading, as OPTICAL_FLOW_RAD.

    A positive rotation of the vehicle about an axis gives a positive flow about this axis. Forward
    motion gives a positive flow about y, motion to the right a negative flow about x.
    """

    flow: frames.Vector
    """(2,) flow about the body's x and y axes [rad]."""
    interval_s: float
    """Integration time [s]; 0 = no measurement."""
    quality: int
    """Quality, 0 = invalid to 255 = best."""
    turned: frames.Vector
    """(3,) angle integrated by the flow sensor's gyro, FRD [rad]; NaN = no gyro."""


class Received(NamedTuple):
    """Reading and its time of arrival [µs]."""

    reading: Any
    time_us: int


class BatterySample(NamedTuple):
    """Sample of the power module."""

    voltage_v: float
    current_a: float
    consumed_mah: float
    remaining: float
    """State of charge 0..1."""


class SensorSample(NamedTuple):
    """Sensor values of one tick; slower sensors have None between their samples."""

    time_us: int
    accel: frames.Vector  # (3,) specific force FRD [m/s²], (0, 0, -9.81) at rest
    gyro: frames.Vector  # (3,) FRD [rad/s]
    temperature_c: float
    battery: BatterySample
    mag: frames.Vector | None = None  # (3,) FRD [gauss]
    pressure_hpa: float | None = None
    """Static pressure [hPa]."""
    gps: GpsFix | None = None
    esc_outputs: tuple[float, float, float, float] | None = None
    """Motor outputs reported by the ESCs, as equivalent commands 0..1 of healthy motors; None =
    equal to the commands."""
    odometry: Odometry | None = None
    """Pose from the vehicle's own vision system."""
    distance: DistanceReading | None = None
    """Range of the vehicle's own rangefinder."""
    flow: FlowReading | None = None
    """Reading of the vehicle's own optical flow sensor."""
    further: Mapping[str, Any] | None = None
    """Readings of the vehicle's further sensors by name (`sensor_table`)."""


class ActuatorControls(NamedTuple):
    """Motor commands, PX4 quad-X order: front right, rear left, front left, rear right."""

    time_us: int
    motors: tuple[float, float, float, float]
    """Normalised commands 0..1; all 0 while disarmed."""
    armed: bool


class TrueState(NamedTuple):
    """True state; hidden from the autopilot."""

    time_us: int
    position: frames.Vector  # (3,) NED [m]
    velocity: frames.Vector  # (3,) NED [m/s]
    quaternion: frames.Vector  # (4,) body -> NED
    angular_velocity: frames.Vector  # (3,) FRD [rad/s]
    power_w: float
    battery_remaining: float


class LogEntry(NamedTuple):
    """Flight log on board."""

    utc_s: int
    """Start or completion time of the log [s since 1970]."""
    size_bytes: int


class OpenLog(NamedTuple):
    """Log currently being written."""

    number: int
    """Index in `LogStore.entries`."""
    head_bytes: int
    """Size of the log header: format, parameters."""
    size_bytes: int
    """Current size, at a message boundary."""


class LogStore:
    """Flight logs on board; a log's number is its index in `entries`. This one is empty."""

    def entries(self) -> Sequence[LogEntry]:
        """Return the logs, oldest first."""
        return ()

    def read(self, number: int, offset: int, count: int) -> bytes:
        """Return up to `count` bytes of a log, fewer at its end; none if the log does not exist."""
        del number, offset, count
        return b""

    def open_log(self) -> OpenLog | None:
        """Return the log currently being written; None = no open log."""
        return None

    def command(self, values: tuple[float, ...], time_us: int) -> None:
        """Log a command of a client: the fields of vehicle_command, and its time [µs]."""


class FirmwareLostError(Exception):
    """External firmware died, hangs or sends invalid data, so the flight is invalid.

    Also raised when the process that renders the camera's images has died.
    """


class FirmwareMissingError(errors.UsageError):
    """External firmware cannot be started, or never connected."""


class FlightController(Protocol):
    """Flight controller: maps a tick's sensor sample to motor commands and reports its state.

    Either the built-in autopilot or a bridge to real firmware; a new object for each episode.
    """

    on_message: Callable[[OperatorText], None] | None
    """Callback for every operator text; None = no callback."""

    @property
    def body_by(self) -> Callable[..., PlantBody] | None:
        """Factory of a body that moves elsewhere, see `plant.new_body`; None = a simulated one."""

    @property
    def rate_hz(self) -> int:
        """Required sensor samples per second of simulated time [Hz]."""

    @property
    def flight(self) -> CommanderState:
        """Flight phase and mode."""

    @property
    def internals(self) -> BuiltinAutopilot | None:
        """Built-in autopilot, for the recorder; None for external firmware."""

    def step(self, sample: SensorSample) -> ActuatorControls:
        """Advance to the sample's time and return the motor commands until the next sample.

        External firmware may raise FirmwareLostError.
        """

    def use_truth(self, truth: Callable[[], TrueState]) -> None:
        """Set the source of the true state.

        Simulator interfaces of external firmware send the true state with the sensors.
        """

    def close(self) -> None:
        """Release all resources. Idempotent."""
