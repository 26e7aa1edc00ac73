"""What is logged: uORB topics of PX4 1.16, with its names, units and intervals.

A topic has those of PX4's fields that mean something here; a log describes itself, so readers find
fields by name. Intervals: PX4's default profile (SDLOG_PROFILE), src/modules/logger.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

from airl_mav.core.constants import TICK_US
from airl_mav.core.frames import local_to_geodetic, quat_yaw
from airl_mav.vehicle import atmosphere
from firmware_sim.autopilot.autopilot_state import Arming, AutopilotState, Landed, Mode
from firmware_sim.flight_log.ulog import Topic, Values
from firmware_sim.interfaces import SensorSample, Truth

NAVIGATION_STATES: dict[Mode, int] = {
    Mode.POSITION: 2,
    Mode.MISSION: 3,
    Mode.HOLD: 4,
    Mode.RETURN: 5,
    Mode.OFFBOARD: 14,
    Mode.TAKEOFF: 17,
    Mode.LAND: 18,
}
"""VehicleStatus.nav_state (NAVIGATION_STATE_*) of each mode."""

_DISARMED, _ARMED = 1, 2
"""VehicleStatus.arming_state."""

_ROTARY_WING = 1
"""VehicleStatus.vehicle_type."""

_MOTORS = 12
"""ActuatorMotors.NUM_CONTROLS: those that do not exist are NaN."""

_UNUSED_MOTORS = (math.nan,) * (_MOTORS - 4)
_NO_VECTOR = (math.nan, math.nan, math.nan)
_UNKNOWN = math.nan
_EVERY_MS = 1_000
ON_CHANGE_US = 500 * _EVERY_MS
"""A state is logged when it changes, and this often anyway [µs]."""


class Moment(NamedTuple):
    """What a vehicle and its simulator know after a tick."""

    state: AutopilotState
    truth: Truth
    unix_us: int
    """Calendar time [µs since 1970]."""


@dataclass(frozen=True)
class Logged:
    """A topic, how often it is logged, and its fields' values (None = there is nothing to log)."""

    topic: Topic
    interval_us: int
    values: Callable[[Moment], Values | None]
    on_change: bool = False
    """Whether a change is logged at once; otherwise the interval alone decides."""


def sensor_combined(sample: SensorSample) -> Values:
    """Return the newest IMU sample, raw: FRD [rad/s], [m/s²]."""
    offset_us, clipping = 0, (0, 0)
    return (*sample.gyro.tolist(), TICK_US, offset_us, *sample.accel.tolist(), TICK_US, *clipping)


SENSOR_COMBINED = Topic(
    "sensor_combined",
    (
        "float[3] gyro_rad",
        "uint32_t gyro_integral_dt",
        "int32_t accelerometer_timestamp_relative",
        "float[3] accelerometer_m_s2",
        "uint32_t accelerometer_integral_dt",
        "uint8_t accelerometer_clipping",
        "uint8_t gyro_clipping",
    ),
)
"""Logged at every tick, from the sample itself: see `sensor_combined`."""


def _angular_velocity(moment: Moment) -> Values:
    estimate = moment.state.estimate
    return estimate.time_us, *estimate.angular_velocity.tolist()


def _rates_setpoint(moment: Moment) -> Values:
    state = moment.state
    return *state.rate_setpoint.tolist(), 0.0, 0.0, -state.thrust_setpoint


def _attitude(moment: Moment) -> Values:
    estimate = moment.state.estimate
    return estimate.time_us, *estimate.quaternion.tolist()


def _true_attitude(moment: Moment) -> Values:
    return moment.truth.time_us, *moment.truth.quaternion.tolist()


def _attitude_setpoint(moment: Moment) -> Values:
    state = moment.state
    yaw_rate = state.setpoint.yaw_rate
    moved = 0.0 if math.isnan(yaw_rate) else yaw_rate
    return moved, *state.attitude_setpoint.tolist(), 0.0, 0.0, -state.thrust_setpoint


def _acceleration(moment: Moment) -> Values:
    state = moment.state
    return state.time_us, *(state.accel - state.estimate.accel_bias).tolist()


def _local_position(moment: Moment) -> Values:
    state = moment.state
    estimate, origin = state.estimate, state.origin
    sigma = estimate.sigma.tolist()
    known = origin is not None
    reference = (math.nan, math.nan, math.nan) if origin is None else origin
    velocity, healthy = estimate.velocity.tolist(), bool(estimate.healthy)
    return (
        estimate.time_us,
        *reference[:2],
        *estimate.position.tolist(),
        *velocity,
        velocity[2],
        *estimate.acceleration.tolist(),
        quat_yaw(estimate.quaternion),
        reference[2],
        math.hypot(*sigma[0:2]),
        sigma[2],
        math.hypot(*sigma[3:5]),
        sigma[5],
        *(healthy,) * 4,
        *(known and healthy,) * 2,
    )


def _true_local_position(moment: Moment) -> Values:
    truth = moment.truth
    velocity = truth.velocity.tolist()
    heading = quat_yaw(truth.quaternion)
    return truth.time_us, *truth.position.tolist(), *velocity, velocity[2], heading, *(True,) * 4


def _local_position_setpoint(moment: Moment) -> Values:
    setpoint = moment.state.setpoint
    position, velocity = setpoint.position.tolist(), setpoint.velocity.tolist()
    return (*position, *velocity, *_NO_VECTOR, *_NO_VECTOR, setpoint.yaw, setpoint.yaw_rate)


def _motors(moment: Moment) -> Values:
    state = moment.state
    armed = state.status.arming is Arming.ARMED
    motors = state.motors if armed else (math.nan,) * 4
    return state.time_us, *motors, *_UNUSED_MOTORS, 0


def _gps(moment: Moment) -> Values | None:
    fix = moment.state.gps
    if fix is None:
        return None
    latitude, longitude, altitude = fix.position
    north, east, down = fix.velocity_ned.tolist()
    return (
        moment.state.time_us,
        latitude,
        longitude,
        altitude,
        altitude,
        moment.unix_us,
        fix.eph_m,
        fix.epv_m,
        math.hypot(north, east, down),
        north,
        east,
        down,
        math.atan2(east, north),
        fix.fix_type,
        True,
        fix.satellites,
    )


def _global_position(moment: Moment) -> Values | None:
    state = moment.state
    estimate, origin = state.estimate, state.origin
    if origin is None or not estimate.healthy:
        return None
    latitude, longitude, altitude = local_to_geodetic(estimate.position, origin)
    sigma = estimate.sigma.tolist()
    accuracy = math.hypot(*sigma[0:2]), sigma[2]
    return estimate.time_us, latitude, longitude, altitude, altitude, *accuracy, True, True


def _air_data(moment: Moment) -> Values | None:
    state = moment.state
    if not math.isfinite(state.pressure_hpa):
        return None
    altitude = atmosphere.altitude_m(state.pressure_hpa)
    pa_per_hpa = 100.0
    return state.time_us, altitude, state.temperature_c, pa_per_hpa * state.pressure_hpa


def _magnetometer(moment: Moment) -> Values:
    return moment.state.time_us, *moment.state.mag.tolist()


def _battery(moment: Moment) -> Values:
    voltage, current, consumed, remaining = moment.state.battery
    connected, number = True, 1
    return voltage, current, consumed, remaining, 1.0, _UNKNOWN, connected, number


def _estimator_status(moment: Moment) -> Values:
    estimate = moment.state.estimate
    sigma, ratio = estimate.sigma.tolist(), estimate.innovation_ratio.tolist()
    horizontal, height, heading, vertical = ratio
    accuracy = math.hypot(*sigma[0:2]), sigma[2]
    # PX4's EKF leaves the last two at 0, too.
    health, timeouts = 0, 0
    tests = heading, max(horizontal, vertical), horizontal, height
    return estimate.time_us, *accuracy, *tests, health, timeouts


def _status(moment: Moment) -> Values:
    status = moment.state.status
    return (
        _ARMED if status.arming is Arming.ARMED else _DISARMED,
        NAVIGATION_STATES[status.intended_mode],
        NAVIGATION_STATES[status.mode],
        _ROTARY_WING,
        status.failsafe,
        status.arming is not Arming.BOOT,
    )


def _armed(moment: Moment) -> Values:
    arming = moment.state.status.arming
    return arming is Arming.ARMED, arming is not Arming.BOOT


def _land_detected(moment: Moment) -> Values:
    landed = moment.state.status.landed is Landed.ON_GROUND
    return landed, landed, landed


def _home(moment: Moment) -> Values | None:
    home = moment.state.home
    return None if home is None else (*home, True, True)


_ATTITUDE = ("uint64_t timestamp_sample", "float[4] q")
_POSITION_VELOCITY = (*(f"float {name}" for name in ("x", "y", "z", "vx", "vy", "vz", "z_deriv")),)
_VALID = tuple(f"bool {name}" for name in ("xy_valid", "z_valid", "v_xy_valid", "v_z_valid"))

TOPICS: tuple[Logged, ...] = (
    Logged(
        Topic("vehicle_angular_velocity", ("uint64_t timestamp_sample", "float[3] xyz")),
        20 * _EVERY_MS,
        _angular_velocity,
    ),
    Logged(
        Topic(
            "vehicle_rates_setpoint",
            ("float roll", "float pitch", "float yaw", "float[3] thrust_body"),
        ),
        20 * _EVERY_MS,
        _rates_setpoint,
    ),
    Logged(Topic("vehicle_attitude", _ATTITUDE), 40 * _EVERY_MS, _attitude),
    Logged(Topic("vehicle_attitude_groundtruth", _ATTITUDE), 40 * _EVERY_MS, _true_attitude),
    Logged(
        Topic(
            "vehicle_attitude_setpoint",
            ("float yaw_sp_move_rate", "float[4] q_d", "float[3] thrust_body"),
        ),
        40 * _EVERY_MS,
        _attitude_setpoint,
    ),
    Logged(
        Topic("vehicle_acceleration", ("uint64_t timestamp_sample", "float[3] xyz")),
        40 * _EVERY_MS,
        _acceleration,
    ),
    Logged(
        Topic(
            "vehicle_local_position",
            (
                "uint64_t timestamp_sample",
                "double ref_lat",
                "double ref_lon",
                *_POSITION_VELOCITY,
                *(f"float {name}" for name in ("ax", "ay", "az", "heading", "ref_alt")),
                *(f"float {name}" for name in ("eph", "epv", "evh", "evv")),
                *_VALID,
                "bool xy_global",
                "bool z_global",
            ),
        ),
        100 * _EVERY_MS,
        _local_position,
    ),
    Logged(
        Topic(
            "vehicle_local_position_groundtruth",
            ("uint64_t timestamp_sample", *_POSITION_VELOCITY, "float heading", *_VALID),
        ),
        100 * _EVERY_MS,
        _true_local_position,
    ),
    Logged(
        Topic(
            "vehicle_local_position_setpoint",
            (
                *(f"float {name}" for name in ("x", "y", "z", "vx", "vy", "vz")),
                *("float[3] acceleration", "float[3] thrust", "float yaw", "float yawspeed"),
            ),
        ),
        100 * _EVERY_MS,
        _local_position_setpoint,
    ),
    Logged(
        Topic(
            "actuator_motors",
            ("uint64_t timestamp_sample", f"float[{_MOTORS}] control", "uint16_t reversible_flags"),
        ),
        100 * _EVERY_MS,
        _motors,
    ),
    Logged(
        Topic(
            "vehicle_gps_position",
            (
                "uint64_t timestamp_sample",
                *("double latitude_deg", "double longitude_deg"),
                *("double altitude_msl_m", "double altitude_ellipsoid_m"),
                "uint64_t time_utc_usec",
                *("float eph", "float epv", "float vel_m_s"),
                *("float vel_n_m_s", "float vel_e_m_s", "float vel_d_m_s", "float cog_rad"),
                *("uint8_t fix_type", "bool vel_ned_valid", "uint8_t satellites_used"),
            ),
        ),
        100 * _EVERY_MS,
        _gps,
    ),
    Logged(
        Topic(
            "vehicle_global_position",
            (
                *("uint64_t timestamp_sample", "double lat", "double lon"),
                *("float alt", "float alt_ellipsoid", "float eph", "float epv"),
                *("bool lat_lon_valid", "bool alt_valid"),
            ),
        ),
        200 * _EVERY_MS,
        _global_position,
    ),
    Logged(
        Topic(
            "vehicle_air_data",
            (
                *("uint64_t timestamp_sample", "float baro_alt_meter"),
                *("float baro_temp_celcius", "float baro_pressure_pa"),
            ),
        ),
        200 * _EVERY_MS,
        _air_data,
    ),
    Logged(
        Topic("vehicle_magnetometer", ("uint64_t timestamp_sample", "float[3] magnetometer_ga")),
        200 * _EVERY_MS,
        _magnetometer,
    ),
    Logged(
        Topic(
            "battery_status",
            (
                *("float voltage_v", "float current_a", "float discharged_mah", "float remaining"),
                *("float scale", "float temperature", "bool connected", "uint8_t id"),
            ),
        ),
        200 * _EVERY_MS,
        _battery,
    ),
    Logged(
        Topic(
            "estimator_status",
            (
                *("uint64_t timestamp_sample", "float pos_horiz_accuracy"),
                *("float pos_vert_accuracy", "float hdg_test_ratio", "float vel_test_ratio"),
                *("float pos_test_ratio", "float hgt_test_ratio"),
                *("uint8_t health_flags", "uint8_t timeout_flags"),
            ),
        ),
        200 * _EVERY_MS,
        _estimator_status,
    ),
    Logged(
        Topic(
            "vehicle_status",
            (
                *("uint8_t arming_state", "uint8_t nav_state_user_intention", "uint8_t nav_state"),
                *("uint8_t vehicle_type", "bool failsafe", "bool pre_flight_checks_pass"),
            ),
        ),
        ON_CHANGE_US,
        _status,
        on_change=True,
    ),
    Logged(
        Topic("actuator_armed", ("bool armed", "bool ready_to_arm")),
        ON_CHANGE_US,
        _armed,
        on_change=True,
    ),
    Logged(
        Topic("vehicle_land_detected", ("bool ground_contact", "bool maybe_landed", "bool landed")),
        ON_CHANGE_US,
        _land_detected,
        on_change=True,
    ),
    Logged(
        Topic(
            "home_position",
            ("double lat", "double lon", "float alt", "bool valid_alt", "bool valid_hpos"),
        ),
        ON_CHANGE_US,
        _home,
        on_change=True,
    ),
)
