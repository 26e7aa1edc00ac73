"""Logged uORB topics of PX4 1.16, with its names, units and intervals.

A topic has those of PX4's fields that mean something here; a log describes itself, so readers find
fields by name. Intervals: PX4's default profile (SDLOG_PROFILE), src/modules/logger.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from airl_mav.core.constants import US_PER_MS
from firmware_sim.flight_log import values
from firmware_sim.flight_log.ulog import Topic, Values
from firmware_sim.flight_log.values import MOTORS, Moment

ON_CHANGE_US = 500 * US_PER_MS
"""A state is logged when it changes, and this often anyway [µs]."""


@dataclass(frozen=True)
class Logged:
    """A topic, how often it is logged, and its fields' values (None = there is nothing to log)."""

    topic: Topic
    interval_us: int
    values: Callable[[Moment], Values | None]
    on_change: bool = False
    """Whether a change is logged at once; otherwise the interval alone decides."""


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
"""Logged at every tick, from the sample itself: see `values.sensor_combined`."""


def _logged(
    name: str,
    interval_ms: int | None,
    values: Callable[[Moment], Values | None],
    fields: str,
) -> Logged:
    """Return a topic whose fields are "type name ...; type name ..."; None = logged on change."""
    groups = (group.split() for group in fields.split("; "))
    each = tuple(f"{kind} {name}" for kind, *names in groups for name in names)
    interval_us = ON_CHANGE_US if interval_ms is None else interval_ms * US_PER_MS
    return Logged(Topic(name, each), interval_us, values, on_change=interval_ms is None)


TOPICS: tuple[Logged, ...] = (
    _logged(
        "vehicle_angular_velocity",
        20,
        values.angular_velocity,
        "uint64_t timestamp_sample; float[3] xyz",
    ),
    _logged(
        "vehicle_rates_setpoint",
        20,
        values.rates_setpoint,
        "float roll pitch yaw; float[3] thrust_body",
    ),
    _logged("vehicle_attitude", 40, values.attitude, "uint64_t timestamp_sample; float[4] q"),
    _logged(
        "vehicle_attitude_groundtruth",
        40,
        values.true_attitude,
        "uint64_t timestamp_sample; float[4] q",
    ),
    _logged(
        "vehicle_attitude_setpoint",
        40,
        values.attitude_setpoint,
        "float yaw_sp_move_rate; float[4] q_d; float[3] thrust_body",
    ),
    _logged(
        "vehicle_acceleration", 40, values.acceleration, "uint64_t timestamp_sample; float[3] xyz"
    ),
    _logged(
        "vehicle_local_position",
        100,
        values.local_position,
        "uint64_t timestamp_sample; double ref_lat ref_lon; "
        "float x y z vx vy vz z_deriv ax ay az heading ref_alt eph epv evh evv; "
        "bool xy_valid z_valid v_xy_valid v_z_valid xy_global z_global; "
        "float dist_bottom dist_bottom_var; bool dist_bottom_valid; "
        "uint8_t dist_bottom_reset_counter dist_bottom_sensor_bitfield",
    ),
    _logged(
        "vehicle_local_position_groundtruth",
        100,
        values.true_local_position,
        "uint64_t timestamp_sample; float x y z vx vy vz z_deriv heading; "
        "bool xy_valid z_valid v_xy_valid v_z_valid",
    ),
    _logged(
        "vehicle_local_position_setpoint",
        100,
        values.local_position_setpoint,
        "float x y z vx vy vz; float[3] acceleration thrust; float yaw yawspeed",
    ),
    _logged(
        "actuator_motors",
        100,
        values.motors,
        f"uint64_t timestamp_sample; float[{MOTORS}] control; uint16_t reversible_flags",
    ),
    _logged(
        "vehicle_gps_position",
        100,
        values.gps,
        "uint64_t timestamp_sample; "
        "double latitude_deg longitude_deg altitude_msl_m altitude_ellipsoid_m; "
        "uint64_t time_utc_usec; float eph epv vel_m_s vel_n_m_s vel_e_m_s vel_d_m_s cog_rad; "
        "uint8_t fix_type; bool vel_ned_valid; uint8_t satellites_used",
    ),
    _logged(
        "vehicle_visual_odometry",
        40,
        values.visual_odometry,
        "uint64_t timestamp_sample; uint8_t pose_frame; float[3] position; float[4] q; "
        "uint8_t velocity_frame; "
        "float[3] velocity angular_velocity position_variance orientation_variance "
        "velocity_variance; uint8_t reset_counter; int8_t quality",
    ),
    _logged(
        "distance_sensor",
        1000,
        values.distance_sensor,
        "uint32_t device_id; float min_distance max_distance current_distance variance; "
        "int8_t signal_quality; uint8_t type; float h_fov v_fov; float[4] q; "
        "uint8_t orientation mode",
    ),
    _logged(
        "vehicle_optical_flow",
        500,
        values.optical_flow,
        "uint64_t timestamp_sample; uint32_t device_id; float[2] pixel_flow; "
        "float[3] delta_angle; float distance_m; uint32_t integration_timespan_us; "
        "uint8_t quality; float max_flow_rate min_ground_distance max_ground_distance",
    ),
    _logged(
        "vehicle_global_position",
        200,
        values.global_position,
        "uint64_t timestamp_sample; double lat lon; float alt alt_ellipsoid eph epv; "
        "bool lat_lon_valid alt_valid",
    ),
    _logged(
        "vehicle_air_data",
        200,
        values.air_data,
        "uint64_t timestamp_sample; float baro_alt_meter baro_temp_celcius baro_pressure_pa",
    ),
    _logged(
        "vehicle_magnetometer",
        200,
        values.magnetometer,
        "uint64_t timestamp_sample; float[3] magnetometer_ga",
    ),
    _logged(
        "battery_status",
        200,
        values.battery,
        "float voltage_v current_a discharged_mah remaining scale temperature; bool connected; "
        "uint8_t id",
    ),
    _logged(
        "estimator_status",
        200,
        values.estimator_status,
        "uint64_t timestamp_sample; "
        "float pos_horiz_accuracy pos_vert_accuracy hdg_test_ratio vel_test_ratio "
        "pos_test_ratio hgt_test_ratio; uint8_t health_flags timeout_flags",
    ),
    _logged(
        "vehicle_status",
        None,
        values.status,
        "uint8_t arming_state nav_state_user_intention nav_state vehicle_type; "
        "bool failsafe pre_flight_checks_pass",
    ),
    _logged("actuator_armed", None, values.armed, "bool armed ready_to_arm"),
    _logged(
        "vehicle_land_detected",
        None,
        values.land_detected,
        "bool ground_contact maybe_landed landed",
    ),
    _logged(
        "home_position",
        None,
        values.home,
        "double lat lon; float alt; bool valid_alt valid_hpos",
    ),
)
