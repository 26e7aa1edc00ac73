"""Logged uORB topics of PX4 1.16, with PX4's names, units and intervals.

A topic contains the PX4 fields that apply to the simulator; logs are self-describing, so readers
find fields by name. Intervals: PX4's default profile (SDLOG_PROFILE), src/modules/logger.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple, TypeVar

from airl_mav.core import constants, frames
from airl_mav.vehicle import atmosphere
from firmware_sim import interfaces, sensor_table
from firmware_sim.addons.flight_log.ulog_writer import Topic, Values
from firmware_sim.autopilot import autopilot_state, snapshot

ON_CHANGE_US = 500 * constants.US_PER_MS
"""Maximum interval of topics that are logged on change [µs]."""

DISARMED, ARMED = 1, 2
"""VehicleStatus.arming_state."""

ROTARY_WING = 1
"""VehicleStatus.vehicle_type."""

DIST_BOTTOM_SENSOR_RANGE = 1
"""VehicleLocalPosition.dist_bottom_sensor_bitfield."""

MOTORS = 12
"""ActuatorMotors.NUM_CONTROLS; absent motors are NaN."""

_UNUSED_MOTORS = (math.nan,) * (MOTORS - 4)
_NO_VECTOR = (math.nan, math.nan, math.nan)
_UNKNOWN = math.nan


class Moment(NamedTuple):
    """State of a vehicle and its simulator after a tick."""

    state: snapshot.AutopilotState
    truth: interfaces.TrueState
    unix_us: int
    """Calendar time [µs since 1970]."""


@dataclass(frozen=True)
class Logged:
    """Logged topic: interval and function of the field values (None = nothing to log)."""

    topic: Topic
    interval_us: int
    values: Callable[[Moment], Values | None]
    on_change: bool = False
    """True to log a change immediately; otherwise only the interval applies."""


def _topic(name: str, fields: str) -> Topic:
    """Return a topic whose fields are "type name ...; type name ..."."""
    groups = (group.split() for group in fields.split("; "))
    return Topic(name, tuple(f"{kind} {name}" for kind, *names in groups for name in names))


SENSOR_COMBINED = _topic(
    "sensor_combined",
    "float[3] gyro_rad; uint32_t gyro_integral_dt; int32_t accelerometer_timestamp_relative; "
    "float[3] accelerometer_m_s2; uint32_t accelerometer_integral_dt; "
    "uint8_t accelerometer_clipping gyro_clipping",
)
"""Topic logged at every tick; see `sensor_combined`."""

TOPICS: list[Logged] = []
"""Logged topics, in the order of definition below."""

_Values = TypeVar("_Values", bound=Callable[[Moment], "Values | None"])


def _logged(name: str, interval_ms: int | None, fields: str) -> Callable[[_Values], _Values]:
    """Log a function's values as a topic; an interval of None = on change."""
    interval_us = ON_CHANGE_US if interval_ms is None else interval_ms * constants.US_PER_MS

    def register(values: _Values) -> _Values:
        TOPICS.append(Logged(_topic(name, fields), interval_us, values, interval_ms is None))
        return values

    return register


def sensor_combined(gyro: Sequence[float], accel: Sequence[float]) -> Values:
    """Return a raw IMU sample: FRD [rad/s], [m/s²]."""
    offset_us, clipping = 0, (0, 0)
    return (*gyro, constants.TICK_US, offset_us, *accel, constants.TICK_US, *clipping)


@_logged("vehicle_angular_velocity", 20, "uint64_t timestamp_sample; float[3] xyz")
def angular_velocity(moment: Moment) -> Values:
    """Return the estimated body rates FRD [rad/s]."""
    estimate = moment.state.estimate
    return estimate.time_us, *estimate.angular_velocity.tolist()


@_logged("vehicle_rates_setpoint", 20, "float roll pitch yaw; float[3] thrust_body")
def rates_setpoint(moment: Moment) -> Values:
    """Return the body rate setpoint FRD [rad/s] and the thrust setpoint, body -1..0."""
    state = moment.state
    return *state.rate_setpoint.tolist(), 0.0, 0.0, -state.thrust_setpoint


@_logged("vehicle_attitude", 40, "uint64_t timestamp_sample; float[4] q")
def attitude(moment: Moment) -> Values:
    """Return the estimated attitude, body -> NED."""
    estimate = moment.state.estimate
    return estimate.time_us, *estimate.quaternion.tolist()


@_logged("vehicle_attitude_groundtruth", 40, "uint64_t timestamp_sample; float[4] q")
def true_attitude(moment: Moment) -> Values:
    """Return the true attitude, body -> NED."""
    return moment.truth.time_us, *moment.truth.quaternion.tolist()


@_logged(
    "vehicle_attitude_setpoint", 40, "float yaw_sp_move_rate; float[4] q_d; float[3] thrust_body"
)
def attitude_setpoint(moment: Moment) -> Values:
    """Return the setpoints of yaw rate [rad/s], attitude and thrust."""
    state = moment.state
    yaw_rate = state.setpoint.yaw_rate
    moved = 0.0 if math.isnan(yaw_rate) else yaw_rate
    return moved, *state.attitude_setpoint.tolist(), 0.0, 0.0, -state.thrust_setpoint


@_logged("vehicle_acceleration", 40, "uint64_t timestamp_sample; float[3] xyz")
def acceleration(moment: Moment) -> Values:
    """Return the specific force minus the estimated bias, FRD [m/s²]."""
    state = moment.state
    return state.time_us, *(state.accel - state.estimate.accel_bias).tolist()


@_logged(
    "vehicle_local_position",
    100,
    "uint64_t timestamp_sample; double ref_lat ref_lon; "
    "float x y z vx vy vz z_deriv ax ay az heading ref_alt eph epv evh evv; "
    "bool xy_valid z_valid v_xy_valid v_z_valid xy_global z_global; "
    "float dist_bottom dist_bottom_var; bool dist_bottom_valid; "
    "uint8_t dist_bottom_reset_counter dist_bottom_sensor_bitfield",
)
def local_position(moment: Moment) -> Values:
    """Return the estimated position [m] and velocity [m/s], NED, with accuracy and validity."""
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
        frames.quat_yaw(estimate.quaternion),
        reference[2],
        math.hypot(*sigma[0:2]),
        sigma[2],
        math.hypot(*sigma[3:5]),
        sigma[5],
        *(healthy,) * 4,
        *(known and healthy,) * 2,
        *_clearance(state),
    )


def _clearance(state: snapshot.AutopilotState) -> Values:
    """Return the distance to the ground [m], variance [m²], validity, resets and sensor."""
    ground = state.clearance
    if ground is None:
        return _UNKNOWN, _UNKNOWN, False, 0, 0
    return (
        ground.dist_bottom_m,
        ground.variance_m2,
        ground.valid,
        ground.resets % 256,
        DIST_BOTTOM_SENSOR_RANGE if ground.by_range else 0,
    )


@_logged(
    "vehicle_local_position_groundtruth",
    100,
    "uint64_t timestamp_sample; float x y z vx vy vz z_deriv heading; "
    "bool xy_valid z_valid v_xy_valid v_z_valid",
)
def true_local_position(moment: Moment) -> Values:
    """Return the true position [m] and velocity [m/s], NED."""
    truth = moment.truth
    velocity = truth.velocity.tolist()
    heading = frames.quat_yaw(truth.quaternion)
    return truth.time_us, *truth.position.tolist(), *velocity, velocity[2], heading, *(True,) * 4


@_logged(
    "vehicle_local_position_setpoint",
    100,
    "float x y z vx vy vz; float[3] acceleration thrust; float yaw yawspeed",
)
def local_position_setpoint(moment: Moment) -> Values:
    """Return the setpoint of the position controller, NED."""
    setpoint = moment.state.setpoint
    position, velocity = setpoint.position.tolist(), setpoint.velocity.tolist()
    return (*position, *velocity, *_NO_VECTOR, *_NO_VECTOR, setpoint.yaw, setpoint.yaw_rate)


@_logged(
    "actuator_motors",
    100,
    f"uint64_t timestamp_sample; float[{MOTORS}] control; uint16_t reversible_flags",
)
def motors(moment: Moment) -> Values:
    """Return the motor commands 0..1; NaN while disarmed."""
    state = moment.state
    armed = state.status.arming is autopilot_state.Arming.ARMED
    motors = state.motors if armed else (math.nan,) * 4
    return state.time_us, *motors, *_UNUSED_MOTORS, 0


@_logged(
    "vehicle_gps_position",
    100,
    "uint64_t timestamp_sample; "
    "double latitude_deg longitude_deg altitude_msl_m altitude_ellipsoid_m; "
    "uint64_t time_utc_usec; float eph epv vel_m_s vel_n_m_s vel_e_m_s vel_d_m_s cog_rad; "
    "uint8_t fix_type; bool vel_ned_valid; uint8_t satellites_used",
)
def gps(moment: Moment) -> Values | None:
    """Return the newest GPS fix."""
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


def _of_sensor(name: str, logged: sensor_table.SensorTopic) -> Logged:
    """Return the topic of a sensor, whose values are in the flight controller's state."""

    def values(moment: Moment) -> Values | None:
        return logged.values(moment.state)

    return Logged(_topic(name, logged.fields), logged.interval_ms * constants.US_PER_MS, values)


TOPICS += [_of_sensor(*each) for s in sensor_table.sensors().values() for each in s.topics.items()]


@_logged(
    "vehicle_global_position",
    200,
    "uint64_t timestamp_sample; double lat lon; float alt alt_ellipsoid eph epv; "
    "bool lat_lon_valid alt_valid",
)
def global_position(moment: Moment) -> Values | None:
    """Return the estimated global position."""
    state = moment.state
    estimate, origin = state.estimate, state.origin
    if origin is None or not estimate.healthy:
        return None
    latitude, longitude, altitude = frames.local_to_geodetic(estimate.position, origin)
    sigma = estimate.sigma.tolist()
    accuracy = math.hypot(*sigma[0:2]), sigma[2]
    return estimate.time_us, latitude, longitude, altitude, altitude, *accuracy, True, True


@_logged(
    "vehicle_air_data",
    200,
    "uint64_t timestamp_sample; float baro_alt_meter baro_temp_celcius baro_pressure_pa",
)
def air_data(moment: Moment) -> Values | None:
    """Return the pressure [Pa] and the pressure altitude [m]."""
    state = moment.state
    if not math.isfinite(state.pressure_hpa):
        return None
    altitude = atmosphere.altitude_m(state.pressure_hpa)
    pa_per_hpa = 100.0
    return state.time_us, altitude, state.temperature_c, pa_per_hpa * state.pressure_hpa


@_logged("vehicle_magnetometer", 200, "uint64_t timestamp_sample; float[3] magnetometer_ga")
def magnetometer(moment: Moment) -> Values:
    """Return the newest magnetic field FRD [gauss]."""
    return moment.state.time_us, *moment.state.mag.tolist()


@_logged(
    "battery_status",
    200,
    "float voltage_v current_a discharged_mah remaining scale temperature; bool connected; "
    "uint8_t id",
)
def battery(moment: Moment) -> Values:
    """Return the battery status reported by the power module."""
    voltage, current, consumed, remaining = moment.state.battery
    connected, number = True, 1
    return voltage, current, consumed, remaining, 1.0, _UNKNOWN, connected, number


@_logged(
    "estimator_status",
    200,
    "uint64_t timestamp_sample; "
    "float pos_horiz_accuracy pos_vert_accuracy hdg_test_ratio vel_test_ratio "
    "pos_test_ratio hgt_test_ratio; uint8_t health_flags timeout_flags",
)
def estimator_status(moment: Moment) -> Values:
    """Return accuracies [m] and innovation test ratios."""
    estimate = moment.state.estimate
    sigma, ratio = estimate.sigma.tolist(), estimate.innovation_ratio.tolist()
    horizontal, height, heading, vertical = ratio
    accuracy = math.hypot(*sigma[0:2]), sigma[2]
    # PX4's EKF also leaves the last two at 0.
    health, timeouts = 0, 0
    tests = heading, max(horizontal, vertical), horizontal, height
    return estimate.time_us, *accuracy, *tests, health, timeouts


@_logged(
    "vehicle_status",
    None,
    "uint8_t arming_state nav_state_user_intention nav_state vehicle_type; "
    "bool failsafe pre_flight_checks_pass",
)
def status(moment: Moment) -> Values:
    """Return the arming state and the flight mode."""
    status = moment.state.status
    return (
        ARMED if status.arming is autopilot_state.Arming.ARMED else DISARMED,
        status.intended_mode.spec.state,
        status.mode.spec.state,
        ROTARY_WING,
        status.failsafe,
        status.arming is not autopilot_state.Arming.BOOT,
    )


@_logged("actuator_armed", None, "bool armed ready_to_arm")
def armed(moment: Moment) -> Values:
    """Return the armed flag and the ready-to-arm flag."""
    arming = moment.state.status.arming
    return arming is autopilot_state.Arming.ARMED, arming is not autopilot_state.Arming.BOOT


@_logged("vehicle_land_detected", None, "bool ground_contact maybe_landed landed")
def land_detected(moment: Moment) -> Values:
    """Return the landed flags."""
    landed = moment.state.status.landed is autopilot_state.Landed.ON_GROUND
    return landed, landed, landed


@_logged("home_position", None, "double lat lon; float alt; bool valid_alt valid_hpos")
def home(moment: Moment) -> Values | None:
    """Return the home position."""
    home = moment.state.home
    return None if home is None else (*home, True, True)
