"""External vision, rangefinder and optical flow sensor: MAVLink streams and topics of the log."""

from __future__ import annotations

import math

from airl_mav.core import constants, frames
from firmware_sim import interfaces, sensor_table
from firmware_sim.autopilot.snapshot import AutopilotState
from firmware_sim.mavlink.streams import units

NEW_US = 200_000
"""Maximum age of a sent measurement [µs]: the longest time that PX4's estimator waits for the next.
PX4 sends a measurement once."""

LEAST_HEIGHT_M, GREATEST_HEIGHT_M, GREATEST_RAD_S = 0.08, 100.0, 8.0
"""Valid range of flow: defaults of SENS_FLOW_MINHGT, SENS_FLOW_MAXHGT and SENS_FLOW_MAXR."""

POSE_FRAMES: dict[interfaces.PoseFrame, int] = {"ned": 1, "frd": 2}
"""VehicleOdometry.pose_frame."""

VELOCITY_FRAMES: dict[interfaces.VelocityFrame, int] = {"ned": 1, "frd": 2, "body": 3}
"""VehicleOdometry.velocity_frame."""

_CM, _CM2 = 1e2, 1e4
_FIRST = 0
_LASER, _KINDS = 0, (0, 1, 2)
"""MAV_DISTANCE_SENSOR values: laser, ultrasound, infrared. Other types are sent as laser."""
_NO_FIELD_OF_VIEW = (0.0, 0.0)
_NO_QUATERNION = (0.0, 0.0, 0.0, 0.0)
_QUALITY_NOT_TOLD = 0
_TEMPERATURE, _NO_DISTANCE_US, _NO_DISTANCE_M = 0, 0, -1.0
_NO_VECTOR = (math.nan, math.nan, math.nan)


def distance_sensor(state: AutopilotState) -> sensor_table.Values | None:
    """Return the newest distance [cm]; None if outdated. PX4 does not send its quality."""
    newest = state.readings.get("distance")
    if newest is None or state.time_us - newest.time_us > NEW_US:
        return None
    told: interfaces.DistanceReading = newest.reading
    return (
        units.boot_ms(newest.time_us),
        _whole(told.least_m * _CM),
        _whole(told.greatest_m * _CM),
        _whole(told.distance_m * _CM),
        told.kind if told.kind in _KINDS else _LASER,
        _FIRST,
        told.orientation,
        # The variance [cm²] is one byte on the wire and saturates.
        units.saturate(math.floor(told.variance_m2 * _CM2), 0, 255, 0),
        *_NO_FIELD_OF_VIEW,
        *_NO_QUATERNION,
        _QUALITY_NOT_TOLD,
    )


def _whole(value: float) -> int:
    """Return a number for a uint16 field, truncated as in C."""
    return units.uint16(math.floor(value + 1e-9), unknown=0)


def optical_flow_rad(state: AutopilotState) -> sensor_table.Values | None:
    """Return the newest flow and rotation [rad]; None if outdated."""
    newest = state.readings.get("flow")
    if newest is None or state.time_us - newest.time_us > NEW_US:
        return None
    told: interfaces.FlowReading = newest.reading
    return (
        newest.time_us,
        _FIRST,
        round(told.interval_s * constants.US_PER_S),
        *told.flow.tolist(),
        *told.turned.tolist(),
        _TEMPERATURE,
        told.quality,
        _NO_DISTANCE_US,
        _NO_DISTANCE_M,
    )


def _visual_odometry(state: AutopilotState) -> sensor_table.Values | None:
    newest = state.readings.get("odometry")
    if newest is None:
        return None
    told = newest.reading

    def numbers(values: frames.Vector | None, count: int) -> list[float]:
        return [math.nan] * count if values is None else list(map(float, values))

    return (
        newest.time_us,
        POSE_FRAMES[told.pose_frame],
        *numbers(told.position, 3),
        *numbers(told.quaternion, 4),
        VELOCITY_FRAMES[told.velocity_frame],
        *numbers(told.velocity, 3),
        *_NO_VECTOR,
        *numbers(told.position_variance, 3),
        *numbers(told.orientation_variance, 3),
        *numbers(told.velocity_variance, 3),
        told.reset_counter,
        told.quality,
    )


def _distance(state: AutopilotState) -> sensor_table.Values | None:
    newest = state.readings.get("distance")
    if newest is None:
        return None
    told, enabled = newest.reading, 1
    return (
        _FIRST,
        told.least_m,
        told.greatest_m,
        told.distance_m,
        told.variance_m2,
        told.quality,
        told.kind,
        *_NO_FIELD_OF_VIEW,
        *_NO_QUATERNION,
        told.orientation,
        enabled,
    )


def _optical_flow(state: AutopilotState) -> sensor_table.Values | None:
    newest = state.readings.get("flow")
    if newest is None:
        return None
    told = newest.reading
    return (
        newest.time_us,
        _FIRST,
        *told.flow.tolist(),
        *told.turned.tolist(),
        math.nan,
        round(told.interval_s * constants.US_PER_S),
        told.quality,
        GREATEST_RAD_S,
        LEAST_HEIGHT_M,
        GREATEST_HEIGHT_M,
    )


_SIMULATED = "firmware_sim.addons.auxiliary_estimation.simulated_sensors"

VISION = sensor_table.Sensor(
    "odometry",
    f"{_SIMULATED}:PlantVision",
    topics={
        "vehicle_visual_odometry": sensor_table.SensorTopic(
            40,
            "uint64_t timestamp_sample; uint8_t pose_frame; float[3] position; float[4] q; "
            "uint8_t velocity_frame; "
            "float[3] velocity angular_velocity position_variance orientation_variance "
            "velocity_variance; uint8_t reset_counter; int8_t quality",
            _visual_odometry,
        )
    },
    draws_always=True,
)

RANGEFINDER = sensor_table.Sensor(
    "distance",
    f"{_SIMULATED}:PlantRangefinder",
    {"DISTANCE_SENSOR": sensor_table.SensorStream(distance_sensor)},
    {
        "distance_sensor": sensor_table.SensorTopic(
            1000,
            "uint32_t device_id; float min_distance max_distance current_distance variance; "
            "int8_t signal_quality; uint8_t type; float h_fov v_fov; float[4] q; "
            "uint8_t orientation mode",
            _distance,
        )
    },
)

OPTICAL_FLOW = sensor_table.Sensor(
    "flow",
    f"{_SIMULATED}:PlantOpticalFlow",
    {"OPTICAL_FLOW_RAD": sensor_table.SensorStream(optical_flow_rad)},
    {
        "vehicle_optical_flow": sensor_table.SensorTopic(
            500,
            "uint64_t timestamp_sample; uint32_t device_id; float[2] pixel_flow; "
            "float[3] delta_angle; float distance_m; uint32_t integration_timespan_us; "
            "uint8_t quality; float max_flow_rate min_ground_distance max_ground_distance",
            _optical_flow,
        )
    },
)
