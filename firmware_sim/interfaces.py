"""The seam between plant and autopilot: PX4's simulator interface as plain data.

A plant turns motor commands into sensor samples; an autopilot turns sensor samples into motor
commands. Real firmware sits behind the same two messages (HIL_SENSOR / HIL_ACTUATOR_CONTROLS).

All are named tuples, which are faster to create than dataclasses: that counts at 250 Hz and a
hundred times real time.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np

from airl_mav.core.frames import Geodetic, Vector

UNKNOWN_VARIANCE = np.full(3, np.nan)
UNKNOWN_VARIANCE.setflags(write=False)

PoseFrame = Literal["ned", "frd"]
"""What a pose is measured in: north, east, down; or forward, right, down as it was at first, with a
heading that nobody knows."""

DOWNWARD = 25
"""MAV_SENSOR_ROTATION_PITCH_270: a distance sensor that looks down."""

VelocityFrame = Literal["ned", "frd", "body"]
"""What a velocity is measured in: as a pose, or in the vehicle's own axes FRD."""


class GpsFix(NamedTuple):
    """One GPS solution."""

    position: Geodetic
    velocity_ned: Vector  # (3,) [m/s]
    eph_m: float
    """Horizontal standard deviation [m]."""
    epv_m: float
    """Vertical standard deviation [m]."""
    satellites: int
    fix_type: int = 3
    """GPS_FIX_TYPE: 3 = 3-D fix."""


class Odometry(NamedTuple):
    """One pose that something other than the flight controller has estimated: vision, mocap.

    The fields are those of PX4's vehicle_odometry. What is None is not measured; a variance that is
    not finite is not known.
    """

    position: Vector | None = None  # (3,) in the pose's frame [m]
    velocity: Vector | None = None  # (3,) in the velocity's frame [m/s]
    quaternion: Vector | None = None  # (4,) body FRD -> the pose's frame, of length 1
    pose_frame: PoseFrame = "ned"
    velocity_frame: VelocityFrame = "ned"
    position_variance: Vector = UNKNOWN_VARIANCE  # (3,) [m²]
    velocity_variance: Vector = UNKNOWN_VARIANCE  # (3,) [m²/s²]
    orientation_variance: Vector = UNKNOWN_VARIANCE  # (3,) roll, pitch, yaw [rad²]
    reset_counter: int = 0
    """Another number than before: what was measured has jumped."""
    quality: int = 0
    """Percent; 0 = not told."""


class DistanceReading(NamedTuple):
    """One range of a distance sensor. The fields are those of PX4's distance_sensor."""

    distance_m: float
    least_m: float
    """Minimum range [m]."""
    greatest_m: float
    """Maximum range [m]."""
    variance_m2: float = 0.0
    """0 = not told."""
    quality: int = -1
    """Percent; 0 = invalid, -1 = not told."""
    orientation: int = DOWNWARD
    """MAV_SENSOR_ORIENTATION."""
    kind: int = 0
    """MAV_DISTANCE_SENSOR: 0 = laser."""


class FlowReading(NamedTuple):
    """How the ground below has moved in an image since the reading before, as OPTICAL_FLOW_RAD.

    A turn of the vehicle about an axis is a positive flow about it, and so is a motion forward
    about y. A motion to the right is a negative flow about x.
    """

    flow: Vector
    """(2,) about the body's x and y axes [rad]."""
    interval_s: float
    """How long it took; 0 = nothing was measured."""
    quality: int
    """0 = invalid to 255 = best."""
    turned: Vector
    """(3,) how far its own gyro has turned meanwhile, FRD [rad]; NaN = it has none."""


class BatterySample(NamedTuple):
    """A sample of the power module."""

    voltage_v: float
    current_a: float
    consumed_mah: float
    remaining: float
    """State of charge 0..1."""


class SensorSample(NamedTuple):
    """Everything measured at one tick; slower sensors are None between their samples."""

    time_us: int
    accel: Vector  # (3,) specific force FRD [m/s²], (0, 0, -9.81) at rest
    gyro: Vector  # (3,) FRD [rad/s]
    temperature_c: float
    battery: BatterySample
    mag: Vector | None = None  # (3,) FRD [gauss]
    pressure_hpa: float | None = None
    """Static pressure [hPa]."""
    gps: GpsFix | None = None
    esc_outputs: tuple[float, float, float, float] | None = None
    """What the speed controllers report that their motors do, as commands 0..1 of healthy ones;
    None: what they are told."""
    odometry: Odometry | None = None
    """Of external vision that is part of the vehicle."""
    distance: DistanceReading | None = None
    """Of a rangefinder that is part of the vehicle."""
    flow: FlowReading | None = None
    """Of an optical flow sensor that is part of the vehicle."""


class ActuatorControls(NamedTuple):
    """Motor commands, PX4 quad-X order: front right, rear left, front left, rear right."""

    time_us: int
    motors: tuple[float, float, float, float]
    """Normalised commands 0..1; all 0 while disarmed."""
    armed: bool


class Truth(NamedTuple):
    """The true state; never shown to the autopilot."""

    time_us: int
    position: Vector  # (3,) NED [m]
    velocity: Vector  # (3,) NED [m/s]
    quaternion: Vector  # (4,) body -> NED
    angular_velocity: Vector  # (3,) FRD [rad/s]
    power_w: float
    battery_remaining: float
