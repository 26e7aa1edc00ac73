"""Logged uORB topics of PX4 1.16, with its names, units and intervals.

A topic has those of PX4's fields that mean something here; a log describes itself, so readers find
fields by name. Intervals: PX4's default profile (SDLOG_PROFILE), src/modules/logger.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from firmware_sim.flight_log import values
from firmware_sim.flight_log.ulog import Topic, Values
from firmware_sim.flight_log.values import MOTORS, Moment

_EVERY_MS = 1_000
ON_CHANGE_US = 500 * _EVERY_MS
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

_ATTITUDE = ("uint64_t timestamp_sample", "float[4] q")
_POSITION_VELOCITY = (*(f"float {name}" for name in ("x", "y", "z", "vx", "vy", "vz", "z_deriv")),)
_VALID = tuple(f"bool {name}" for name in ("xy_valid", "z_valid", "v_xy_valid", "v_z_valid"))

TOPICS: tuple[Logged, ...] = (
    Logged(
        Topic("vehicle_angular_velocity", ("uint64_t timestamp_sample", "float[3] xyz")),
        20 * _EVERY_MS,
        values.angular_velocity,
    ),
    Logged(
        Topic(
            "vehicle_rates_setpoint",
            ("float roll", "float pitch", "float yaw", "float[3] thrust_body"),
        ),
        20 * _EVERY_MS,
        values.rates_setpoint,
    ),
    Logged(Topic("vehicle_attitude", _ATTITUDE), 40 * _EVERY_MS, values.attitude),
    Logged(Topic("vehicle_attitude_groundtruth", _ATTITUDE), 40 * _EVERY_MS, values.true_attitude),
    Logged(
        Topic(
            "vehicle_attitude_setpoint",
            ("float yaw_sp_move_rate", "float[4] q_d", "float[3] thrust_body"),
        ),
        40 * _EVERY_MS,
        values.attitude_setpoint,
    ),
    Logged(
        Topic("vehicle_acceleration", ("uint64_t timestamp_sample", "float[3] xyz")),
        40 * _EVERY_MS,
        values.acceleration,
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
                *("float dist_bottom", "float dist_bottom_var", "bool dist_bottom_valid"),
                *("uint8_t dist_bottom_reset_counter", "uint8_t dist_bottom_sensor_bitfield"),
            ),
        ),
        100 * _EVERY_MS,
        values.local_position,
    ),
    Logged(
        Topic(
            "vehicle_local_position_groundtruth",
            ("uint64_t timestamp_sample", *_POSITION_VELOCITY, "float heading", *_VALID),
        ),
        100 * _EVERY_MS,
        values.true_local_position,
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
        values.local_position_setpoint,
    ),
    Logged(
        Topic(
            "actuator_motors",
            ("uint64_t timestamp_sample", f"float[{MOTORS}] control", "uint16_t reversible_flags"),
        ),
        100 * _EVERY_MS,
        values.motors,
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
        values.gps,
    ),
    Logged(
        Topic(
            "vehicle_visual_odometry",
            (
                *("uint64_t timestamp_sample", "uint8_t pose_frame", "float[3] position"),
                *("float[4] q", "uint8_t velocity_frame", "float[3] velocity"),
                *("float[3] angular_velocity", "float[3] position_variance"),
                *("float[3] orientation_variance", "float[3] velocity_variance"),
                *("uint8_t reset_counter", "int8_t quality"),
            ),
        ),
        40 * _EVERY_MS,
        values.visual_odometry,
    ),
    Logged(
        Topic(
            "distance_sensor",
            (
                *("uint32_t device_id", "float min_distance", "float max_distance"),
                *("float current_distance", "float variance", "int8_t signal_quality"),
                *("uint8_t type", "float h_fov", "float v_fov", "float[4] q"),
                *("uint8_t orientation", "uint8_t mode"),
            ),
        ),
        1_000 * _EVERY_MS,
        values.distance_sensor,
    ),
    Logged(
        Topic(
            "vehicle_optical_flow",
            (
                *("uint64_t timestamp_sample", "uint32_t device_id", "float[2] pixel_flow"),
                *("float[3] delta_angle", "float distance_m", "uint32_t integration_timespan_us"),
                *("uint8_t quality", "float max_flow_rate"),
                *("float min_ground_distance", "float max_ground_distance"),
            ),
        ),
        500 * _EVERY_MS,
        values.optical_flow,
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
        values.global_position,
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
        values.air_data,
    ),
    Logged(
        Topic("vehicle_magnetometer", ("uint64_t timestamp_sample", "float[3] magnetometer_ga")),
        200 * _EVERY_MS,
        values.magnetometer,
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
        values.battery,
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
        values.estimator_status,
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
        values.status,
        on_change=True,
    ),
    Logged(
        Topic("actuator_armed", ("bool armed", "bool ready_to_arm")),
        ON_CHANGE_US,
        values.armed,
        on_change=True,
    ),
    Logged(
        Topic("vehicle_land_detected", ("bool ground_contact", "bool maybe_landed", "bool landed")),
        ON_CHANGE_US,
        values.land_detected,
        on_change=True,
    ),
    Logged(
        Topic(
            "home_position",
            ("double lat", "double lon", "float alt", "bool valid_alt", "bool valid_hpos"),
        ),
        ON_CHANGE_US,
        values.home,
        on_change=True,
    ),
)
