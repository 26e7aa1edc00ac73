"""Conversion of sensor samples to MAVLink HIL messages, and of HIL_ACTUATOR_CONTROLS to commands.

PX4 reads these messages on the simulator interface (SITL), and on the normal link of a board in
HITL. Units follow common.xml, or PX4's reader where it differs. `BatterySample` has no message
here: PX4 simulates the battery.
"""

from __future__ import annotations

import math
from typing import NamedTuple, TypeAlias

from airl_mav.core import constants, errors, frames
from airl_mav.vehicle.atmosphere import altitude_m
from firmware_sim import interfaces
from firmware_sim.mavlink.codec import Reader, Values, WireMessage, dialect, layout
from firmware_sim.mavlink.streams.units import triangle

SENSOR = layout("HIL_SENSOR")
GPS = layout("HIL_GPS")
STATE = layout("HIL_STATE_QUATERNION")
ODOMETRY = layout("ODOMETRY")
DISTANCE = layout("DISTANCE_SENSOR")
FLOW = layout("HIL_OPTICAL_FLOW")


class Answer(NamedTuple):
    """Fields of HIL_ACTUATOR_CONTROLS in wire order, with MAVLink's names."""

    time_usec: int
    flags: int
    controls: tuple[float, ...]
    mode: int


Controls: TypeAlias = "Answer | WireMessage"
"""HIL_ACTUATOR_CONTROLS from either decoder."""

_ANSWERS = Reader("HIL_ACTUATOR_CONTROLS")


def _updated(*fields: str) -> int:
    return sum(getattr(dialect, f"HIL_SENSOR_UPDATED_{field}") for field in fields)


IMU_FIELDS = _updated("XACC", "YACC", "ZACC", "XGYRO", "YGYRO", "ZGYRO")
MAG_FIELDS = _updated("XMAG", "YMAG", "ZMAG")
# PX4 reads the temperature as the barometer's, and only together with the pressure.
BARO_FIELDS = _updated("ABS_PRESSURE", "PRESSURE_ALT", "TEMPERATURE")

MOTORS = 4
STILL = (0.0, 0.0, 0.0, 0.0)

TOLERANCE = 1e-3
"""Tolerance of motor commands beyond 0..1, for rounding."""

COURSE_UNKNOWN = 65_535

_ID = 0
"""Id of the single instance of each sensor; PX4 sets its clock from the first IMU."""

_YAW_UNAVAILABLE = 0
_NO_AIRSPEED = 0.0

_POSE_FRAMES = {"ned": dialect.MAV_FRAME_LOCAL_NED, "frd": dialect.MAV_FRAME_LOCAL_FRD}
_VELOCITY_FRAMES = {**_POSE_FRAMES, "body": dialect.MAV_FRAME_BODY_FRD}

_COURSE_MIN_M_S = 0.1
"""Minimum ground speed for a valid GPS course [m/s]."""

_DEGREES = 1e7
_MM = 1e3
_CM = 1e2

ACCEL_LIMIT_M_S2 = 32_767 / 2048 * constants.GRAVITY_M_S2
GYRO_LIMIT_RAD_S = 32_767 / 32_768 * 2000.0 * constants.DEG
"""Range of the inertial sensors simulated by PX4's drivers: 16 g, 2000 deg/s in 16 bits. Values
beyond would wrap around: a hard landing (0.7 m/s stopped within a tick) would look like a fall."""

_UINT8 = (0, 255)
_INT16 = (-32_768, 32_767)
_UINT16 = (0, 65_535)
_INT32 = (-(2**31), 2**31 - 1)


class ControlsError(ValueError):
    """Values of HIL_ACTUATOR_CONTROLS are invalid for a quadrotor."""


def sensor(sample: interfaces.SensorSample, time_us: int) -> Values:
    """Return HIL_SENSOR at the firmware's time [µs]; sensors without a sample are not updated."""
    ax, ay, az = _saturated(sample.accel, ACCEL_LIMIT_M_S2)
    gx, gy, gz = _saturated(sample.gyro, GYRO_LIMIT_RAD_S)
    fields = IMU_FIELDS
    mx = my = mz = pressure = height = 0.0
    if sample.mag is not None:
        fields |= MAG_FIELDS
        mx, my, mz = sample.mag.tolist()
    if sample.pressure_hpa is not None:
        fields |= BARO_FIELDS
        pressure = sample.pressure_hpa
        height = altitude_m(pressure)
    return (
        *(time_us, ax, ay, az, gx, gy, gz, mx, my, mz),
        *(pressure, _NO_AIRSPEED, height, sample.temperature_c, fields, _ID),
    )


def gps(fix: interfaces.GpsFix, time_us: int) -> Values:
    """Return HIL_GPS at a time [µs]; PX4 reads `eph`, `epv` as standard deviations [cm]."""
    north, east, down = fix.velocity_ned.tolist()
    speed = math.hypot(north, east)
    course = COURSE_UNKNOWN
    if speed >= _COURSE_MIN_M_S:
        course = round(math.degrees(math.atan2(east, north)) * _CM) % 36_000
    return (
        time_us,
        fix.fix_type,
        round(fix.position.latitude_deg * _DEGREES),
        round(fix.position.longitude_deg * _DEGREES),
        _fit(fix.position.altitude_m * _MM, _INT32),
        _fit(fix.eph_m * _CM, _UINT16),
        _fit(fix.epv_m * _CM, _UINT16),
        _fit(speed * _CM, _UINT16),
        *(_fit(v * _CM, _INT16) for v in (north, east, down)),
        course,
        fix.satellites,
        _ID,
        _YAW_UNAVAILABLE,
    )


def odometry(seen: interfaces.Odometry, time_us: int) -> Values:
    """Return ODOMETRY at the firmware's time [µs]; NaN = not measured."""
    return (
        time_us,
        _POSE_FRAMES[seen.pose_frame],
        _VELOCITY_FRAMES[seen.velocity_frame],
        *_known(seen.position, 3),
        *_known(seen.quaternion, 4),
        *_known(seen.velocity, 3),
        *_known(None, 3),
        *triangle((*seen.position_variance.tolist(), *seen.orientation_variance.tolist())),
        *triangle((*seen.velocity_variance.tolist(), *_known(None, 3))),
        seen.reset_counter,
        dialect.MAV_ESTIMATOR_TYPE_VIO,
        seen.quality,
    )


def distance(told: interfaces.DistanceReading, time_us: int) -> Values:
    """Return DISTANCE_SENSOR at the firmware's time [µs], in whole centimetres."""
    quality = 0 if told.quality < 0 else 1 + round(told.quality * 0.99)
    return (
        time_us // 1_000 & 0xFFFF_FFFF,
        _fit(told.least_m * _CM, _UINT16),
        _fit(told.greatest_m * _CM, _UINT16),
        _fit(told.distance_m * _CM, _UINT16),
        told.kind,
        _ID,
        told.orientation,
        _fit(told.variance_m2 * _CM * _CM, _UINT8),
        *(0.0, 0.0),
        *(0.0, 0.0, 0.0, 0.0),
        quality,
    )


def flow(told: interfaces.FlowReading, time_us: int) -> Values:
    """Return HIL_OPTICAL_FLOW at the firmware's time [µs], without a distance."""
    temperature, since_us, distance_m = 0, 0, -1.0
    return (
        time_us,
        _ID,
        _fit(told.interval_s * constants.US_PER_S, (0, 2**32 - 1)),
        *told.flow.tolist(),
        *told.turned.tolist(),
        temperature,
        told.quality,
        since_us,
        distance_m,
    )


def armed(message: Controls) -> bool:
    """Return True if HIL_ACTUATOR_CONTROLS reports armed."""
    return bool(message.mode & dialect.MAV_MODE_FLAG_SAFETY_ARMED)


def answer(chunk: bytes) -> Answer | None:
    """Return a chunk of bytes as HIL_ACTUATOR_CONTROLS; None for any other content."""
    values = _ANSWERS.read(chunk)
    if values is None:
        return None
    time_usec, flags, *controls, mode = values
    return Answer(int(time_usec), int(flags), tuple(controls), int(mode))


def lockstep(message: Controls) -> bool:
    """Return True if HIL_ACTUATOR_CONTROLS comes from a lockstep build of PX4."""
    return bool(message.flags & dialect.HIL_ACTUATOR_CONTROLS_FLAGS_LOCKSTEP)


def controls(message: Controls, time_us: int) -> interfaces.ActuatorControls:
    """Return motor commands from `time_us` [µs]; ControlsError outside 0..1 while armed.

    Disarmed motors stop: PX4 in HITL sends commands even then.
    """
    if not armed(message):
        return interfaces.ActuatorControls(time_us, STILL, armed=False)
    a, b, c, d = message.controls[:MOTORS]
    if 0.0 <= a <= 1.0 and 0.0 <= b <= 1.0 and 0.0 <= c <= 1.0 and 0.0 <= d <= 1.0:
        return interfaces.ActuatorControls(time_us, (a, b, c, d), armed=True)
    for i, value in enumerate((a, b, c, d)):
        # The comparison is written so that NaN fails.
        if not -TOLERANCE <= value <= 1.0 + TOLERANCE:
            raise ControlsError(
                f"HIL_ACTUATOR_CONTROLS controls[{i}] = {value:g}: accepted: 0..1 from the motors "
                f"of a quadrotor ({errors.PAGE})"
            )
    a, b, c, d = (min(1.0, max(0.0, value)) for value in (a, b, c, d))
    return interfaces.ActuatorControls(time_us, (a, b, c, d), armed=True)


def _known(values: frames.Vector | None, width: int) -> tuple[float, ...]:
    return (math.nan,) * width if values is None else tuple(values.tolist())


def _saturated(measured: frames.Vector, limit: float) -> tuple[float, float, float]:
    x, y, z = measured.tolist()
    if -limit <= x <= limit and -limit <= y <= limit and -limit <= z <= limit:
        return x, y, z
    return _within(x, limit), _within(y, limit), _within(z, limit)


def _within(value: float, limit: float) -> float:
    return min(limit, max(-limit, value))


def _fit(value: float, limits: tuple[int, int]) -> int:
    low, high = limits
    return round(min(high, max(low, value)))
