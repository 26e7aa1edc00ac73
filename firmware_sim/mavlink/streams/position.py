"""Where the vehicle is, where it should be, and where its origin and home are."""

from __future__ import annotations

import math

from airl_mav import atmosphere
from airl_mav.frames import geodetic_to_local, local_to_geodetic, quat_to_matrix, quat_yaw
from firmware_sim.autopilot.state import Arming, AutopilotState, Estimate
from firmware_sim.mavlink.codec import WireMessage, dialect
from firmware_sim.mavlink.streams.units import (
    NAN,
    boot_ms,
    centidegrees,
    cm_s,
    deg_e7,
    int16,
    mm,
    uint16,
)

_UNKNOWN_QUATERNION = (NAN, NAN, NAN, NAN)

_POSITION_IGNORE = (
    dialect.POSITION_TARGET_TYPEMASK_X_IGNORE,
    dialect.POSITION_TARGET_TYPEMASK_Y_IGNORE,
    dialect.POSITION_TARGET_TYPEMASK_Z_IGNORE,
)
_VELOCITY_IGNORE = (
    dialect.POSITION_TARGET_TYPEMASK_VX_IGNORE,
    dialect.POSITION_TARGET_TYPEMASK_VY_IGNORE,
    dialect.POSITION_TARGET_TYPEMASK_VZ_IGNORE,
)
_ACCELERATION_IGNORE = (
    dialect.POSITION_TARGET_TYPEMASK_AX_IGNORE
    | dialect.POSITION_TARGET_TYPEMASK_AY_IGNORE
    | dialect.POSITION_TARGET_TYPEMASK_AZ_IGNORE
)


def local_position_ned(state: AutopilotState) -> WireMessage | None:
    """Position [m] and velocity [m/s], local NED; nothing until the estimator has converged."""
    estimate = state.estimate
    if not estimate.healthy:
        return None
    return dialect.MAVLink_local_position_ned_message(
        boot_ms(estimate.time_us), *estimate.position.tolist(), *estimate.velocity.tolist()
    )


def global_position_int(state: AutopilotState) -> WireMessage | None:
    """Position on the globe, height above home, NED velocity; nothing without an origin."""
    estimate = state.estimate
    if state.origin is None or not all(map(math.isfinite, estimate.position.tolist())):
        return None
    here = local_to_geodetic(estimate.position, state.origin)
    velocity = estimate.velocity.tolist()
    return dialect.MAVLink_global_position_int_message(
        boot_ms(estimate.time_us),
        deg_e7(here.latitude_deg),
        deg_e7(here.longitude_deg),
        mm(here.altitude_m),
        mm(_height_above_home(state)),
        cm_s(velocity[0]),
        cm_s(velocity[1]),
        cm_s(velocity[2]),
        centidegrees(quat_yaw(estimate.quaternion)),
    )


def odometry(state: AutopilotState) -> WireMessage:
    """Pose in local NED, velocity in body FRD, variances on the diagonals (NaN elsewhere)."""
    estimate = state.estimate
    variance = (estimate.sigma[:9] ** 2).tolist()
    pose_covariance = [NAN] * 21
    velocity_covariance = [NAN] * 21
    # Upper triangle of a 6 x 6 matrix, row by row: 0, 6, 11, 15, 18, 20 is its diagonal.
    for slot, index in ((0, 0), (6, 1), (11, 2), (15, 6), (18, 7), (20, 8)):
        pose_covariance[slot] = variance[index]
    for slot, index in ((0, 3), (6, 4), (11, 5)):
        velocity_covariance[slot] = variance[index]
    return dialect.MAVLink_odometry_message(
        estimate.time_us,
        dialect.MAV_FRAME_LOCAL_NED,
        dialect.MAV_FRAME_BODY_FRD,
        *estimate.position.tolist(),
        estimate.quaternion.tolist(),
        *_in_body(estimate),
        *estimate.angular_velocity.tolist(),
        pose_covariance,
        velocity_covariance,
        0,
        dialect.MAV_ESTIMATOR_TYPE_AUTOPILOT,
        100 if estimate.healthy else 0,
    )


def altitude(state: AutopilotState) -> WireMessage:
    """All altitudes [m]; there is no rangefinder, so terrain is unknown."""
    down = float(state.estimate.position[2])
    return dialect.MAVLink_altitude_message(
        state.time_us,
        atmosphere.altitude_m(state.pressure_hpa),
        NAN if state.origin is None else state.origin.altitude_m - down,
        -down,
        _height_above_home(state),
        NAN,
        NAN,
    )


def vfr_hud(state: AutopilotState) -> WireMessage:
    """The head-up display: ground speed, heading, throttle, altitude, climb; no airspeed sensor."""
    north, east, down = state.estimate.velocity.tolist()
    armed = state.status.arming is Arming.ARMED
    heading = math.degrees(quat_yaw(state.estimate.quaternion)) % 360.0
    return dialect.MAVLink_vfr_hud_message(
        0.0,
        math.hypot(north, east),
        int16(heading) % 360,
        uint16(100.0 * state.thrust_setpoint if armed else 0.0, unknown=0),
        atmosphere.altitude_m(state.pressure_hpa)
        if state.origin is None
        else state.origin.altitude_m - float(state.estimate.position[2]),
        -down,
    )


def position_target_local_ned(state: AutopilotState) -> WireMessage:
    """What the position and velocity controllers track; the mask marks what is not commanded."""
    setpoint = state.setpoint
    position, velocity = setpoint.position.tolist(), setpoint.velocity.tolist()
    mask: int = _ACCELERATION_IGNORE
    for value, bit in zip(position + velocity, _POSITION_IGNORE + _VELOCITY_IGNORE, strict=True):
        if not math.isfinite(value):
            mask |= bit
    if not math.isfinite(setpoint.yaw):
        mask |= dialect.POSITION_TARGET_TYPEMASK_YAW_IGNORE
    if not math.isfinite(setpoint.yaw_rate):
        mask |= dialect.POSITION_TARGET_TYPEMASK_YAW_RATE_IGNORE
    return dialect.MAVLink_position_target_local_ned_message(
        boot_ms(state.time_us),
        dialect.MAV_FRAME_LOCAL_NED,
        mask,
        *position,
        *velocity,
        NAN,
        NAN,
        NAN,
        setpoint.yaw,
        setpoint.yaw_rate,
    )


def home_position(state: AutopilotState) -> WireMessage | None:
    """Home on the globe and in local NED; nothing before it is set."""
    home, origin = state.home, state.origin
    if home is None:
        return None
    local = [NAN, NAN, NAN] if origin is None else geodetic_to_local(home, origin).tolist()
    return dialect.MAVLink_home_position_message(
        deg_e7(home.latitude_deg),
        deg_e7(home.longitude_deg),
        mm(home.altitude_m),
        *local,
        _UNKNOWN_QUATERNION,
        0.0,
        0.0,
        0.0,
        state.time_us,
    )


def gps_global_origin(state: AutopilotState) -> WireMessage | None:
    """The point of the globe where local NED is zero; nothing before it is set."""
    origin = state.origin
    if origin is None:
        return None
    return dialect.MAVLink_gps_global_origin_message(
        deg_e7(origin.latitude_deg),
        deg_e7(origin.longitude_deg),
        mm(origin.altitude_m),
        state.time_us,
    )


def _in_body(estimate: Estimate) -> list[float]:
    """Return the velocity [m/s] in body FRD; plain floats, so that inf raises no warning."""
    north, east, down = estimate.velocity.tolist()
    columns = quat_to_matrix(estimate.quaternion).T.tolist()
    return [n * north + e * east + d * down for n, e, d in columns]


def _height_above_home(state: AutopilotState) -> float:
    """Height above home [m]; above the local origin while either is unknown."""
    up = -float(state.estimate.position[2])
    if state.home is None or state.origin is None:
        return up
    return up + state.origin.altitude_m - state.home.altitude_m
