"""Where the vehicle is and how it points, where and how it should, its origin and home."""

from __future__ import annotations

import math

import numpy as np
from numba.extending import register_jitable

from airl_mav.core.constants import GRAVITY_M_S2
from airl_mav.core.frames import Geodetic, geodetic_to_local, local_to_geodetic, quat_yaw
from airl_mav.core.kernels import kernel
from airl_mav.vehicle import atmosphere
from airl_mav.vehicle.rotation import Vec, rotate, yaw_of
from firmware_sim.autopilot.autopilot_state import Arming, AutopilotState, Vector
from firmware_sim.mavlink.codec import Values, dialect
from firmware_sim.mavlink.streams import units
from firmware_sim.mavlink.streams.distance import clearance

register_jitable(local_to_geodetic)  # so that kernels can call it, as Python can

_NO_ROTATION_OFFSET = (0.0, 0.0, 0.0, 0.0)
"""PX4 saves bytes: zeros mean the identity (tailsitters alone differ)."""

_NO_APPROACH = (0.0, 0.0, 0.0)
"""HOME_POSITION: there is no special way to land."""

_NOTHING = np.full(3, math.nan)
_STOPPED = (0.0, 0.0, 100.0)
"""Acceleration setpoint of stopped motors [m/s²]: PX4's way to say no thrust."""

_UNRATED = 0
"""ODOMETRY.quality: PX4's estimator gives none."""


def attitude(state: AutopilotState) -> Values:
    """Euler angles [rad] and body rates [rad/s]."""
    estimate = state.estimate
    angles, rates = _euler(estimate.quaternion), estimate.angular_velocity.tolist()
    return units.boot_ms(estimate.time_us), *angles, *rates


def attitude_quaternion(state: AutopilotState) -> Values:
    """Quaternion w, x, y, z (body FRD -> NED) and body rates [rad/s]."""
    estimate = state.estimate
    quaternion, rates = estimate.quaternion.tolist(), estimate.angular_velocity.tolist()
    return units.boot_ms(estimate.time_us), *quaternion, *rates, *_NO_ROTATION_OFFSET


def attitude_target(state: AutopilotState) -> Values:
    """What the attitude and rate controllers track; collective thrust 0..1."""
    type_mask = 0
    quaternion, rates = state.attitude_setpoint.tolist(), state.rate_setpoint.tolist()
    return units.boot_ms(state.time_us), type_mask, *quaternion, *rates, state.thrust_setpoint


def local_position_ned(state: AutopilotState) -> Values | None:
    """Position [m] and velocity [m/s], local NED; nothing until the estimator has converged."""
    estimate = state.estimate
    if not estimate.healthy:
        return None
    return units.boot_ms(estimate.time_us), *estimate.position.tolist(), *estimate.velocity.tolist()


def global_position_int(state: AutopilotState) -> Values | None:
    """Position on the globe, height above home, NED velocity; nothing without an origin."""
    estimate, origin, home = state.estimate, state.origin, state.home
    if origin is None or not all(map(math.isfinite, estimate.position.tolist())):
        return None
    return _on_globe(
        estimate.time_us,
        estimate.position,
        estimate.velocity,
        estimate.quaternion,
        *origin,
        origin.altitude_m if home is None else home.altitude_m,
    )


def odometry(state: AutopilotState) -> Values:
    """Pose and velocity in local NED, as PX4 sends both; variances on the diagonals (else NaN)."""
    estimate = state.estimate
    x, y, z, vx, vy, vz, roll, pitch, yaw, *_ = (estimate.sigma**2).tolist()
    reset_counter = 0
    return (
        estimate.time_us,
        dialect.MAV_FRAME_LOCAL_NED,
        dialect.MAV_FRAME_LOCAL_NED,
        *estimate.position.tolist(),
        *estimate.quaternion.tolist(),
        *estimate.velocity.tolist(),
        *estimate.angular_velocity.tolist(),
        *units.triangle((x, y, z, roll, pitch, yaw)),
        *units.triangle((vx, vy, vz, math.nan, math.nan, math.nan)),
        reset_counter,
        dialect.MAV_ESTIMATOR_TYPE_AUTOPILOT,
        _UNRATED,
    )


def altitude(state: AutopilotState) -> Values:
    """All altitudes [m]; terrain is known where a rangefinder tells it."""
    down = float(state.estimate.position[2])
    altitude_terrain, bottom_clearance = clearance(state, down)
    return (
        state.time_us,
        atmosphere.altitude_m(state.pressure_hpa),
        math.nan if state.origin is None else state.origin.altitude_m - down,
        -down,
        _height_above_home(state),
        altitude_terrain,
        bottom_clearance,
    )


def vfr_hud(state: AutopilotState) -> Values:
    """The head-up display: ground speed, heading, throttle, altitude, climb; no airspeed sensor."""
    north, east, down = state.estimate.velocity.tolist()
    armed = state.status.arming is Arming.ARMED
    heading = math.degrees(quat_yaw(state.estimate.quaternion)) % 360.0
    airspeed = 0.0
    return (
        airspeed,
        math.hypot(north, east),
        units.int16(heading) % 360,
        units.uint16(100.0 * state.thrust_setpoint if armed else 0.0, unknown=0),
        atmosphere.altitude_m(state.pressure_hpa)
        if state.origin is None
        else state.origin.altitude_m - float(state.estimate.position[2]),
        -down,
    )


def position_target_local_ned(state: AutopilotState) -> Values:
    """What the position and velocity controllers track; the mask marks what is not commanded.

    Source: PX4 1.16, PositionControl::getLocalPositionSetpoint: the heading, the yaw rate and the
    acceleration are always filled in. Disarmed there is nothing else.
    """
    setpoint = state.setpoint
    position, velocity, acceleration = setpoint.position, setpoint.velocity, _acceleration(state)
    yaw, yaw_rate = setpoint.yaw, setpoint.yaw_rate
    if state.status.arming is not Arming.ARMED:
        position = velocity = _NOTHING
        acceleration, yaw, yaw_rate = _STOPPED, quat_yaw(state.estimate.quaternion), 0.0
    return (
        units.boot_ms(state.time_us),
        dialect.MAV_FRAME_LOCAL_NED,
        _ignored(position, velocity),
        *position.tolist(),
        *velocity.tolist(),
        *acceleration,
        yaw if math.isfinite(yaw) else quat_yaw(state.attitude_setpoint),
        yaw_rate if math.isfinite(yaw_rate) else 0.0,
    )


def position_target_global_int(state: AutopilotState) -> Values | None:
    """Where an automatic mode is going, and how fast the vehicle shall be now; else nothing."""
    target, origin = state.destination, state.origin
    if target is None or origin is None or not all(map(math.isfinite, target)):
        return None
    place = local_to_geodetic(np.array(target), origin)
    yaw, nothing_ignored = state.setpoint.yaw, 0
    return (
        units.boot_ms(state.time_us),
        dialect.MAV_FRAME_GLOBAL_INT,
        nothing_ignored,
        units.deg_e7(place.latitude_deg),
        units.deg_e7(place.longitude_deg),
        place.altitude_m,
        *state.setpoint.velocity.tolist(),
        *_acceleration(state),
        yaw if math.isfinite(yaw) else quat_yaw(state.attitude_setpoint),
        0.0,
    )


def orbit_execution_status(state: AutopilotState) -> Values | None:
    """The circle that is flown: its centre on the globe; nothing in other modes."""
    orbit, origin = state.orbit, state.origin
    if orbit is None or origin is None:
        return None
    centre = local_to_geodetic(np.array(orbit.centre), origin)
    return (
        state.time_us,
        orbit.radius_m,
        dialect.MAV_FRAME_GLOBAL,
        units.deg_e7(centre.latitude_deg),
        units.deg_e7(centre.longitude_deg),
        centre.altitude_m,
    )


def home_position(state: AutopilotState) -> Values | None:
    """Home on the globe and in local NED; nothing before it is set."""
    home, origin = state.home, state.origin
    if home is None:
        return None
    local = (
        [math.nan, math.nan, math.nan]
        if origin is None
        else geodetic_to_local(home, origin).tolist()
    )
    return *_wire(home), *local, *_heading(state.home_yaw), *_NO_APPROACH, state.time_us


def gps_global_origin(state: AutopilotState) -> Values | None:
    """The point of the globe where local NED is zero; nothing before it is set."""
    return None if state.origin is None else (*_wire(state.origin), state.time_us)


def _wire(place: Geodetic) -> Values:
    """Return latitude, longitude [degE7] and altitude [mm]."""
    return (
        units.deg_e7(place.latitude_deg),
        units.deg_e7(place.longitude_deg),
        units.mm(place.altitude_m),
    )


@kernel
def _euler(quaternion: Vector) -> tuple[float, float, float]:
    """Return roll, pitch, yaw [rad] of a quaternion (4,), as `frames.quat_to_euler`."""
    w, x, y, z = quaternion[0], quaternion[1], quaternion[2], quaternion[3]
    roll = math.atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    pitch = math.asin(min(1.0, max(-1.0, 2.0 * (w * y - z * x))))
    return roll, pitch, yaw_of((w, x, y, z))


@kernel
def _on_globe(
    time_us: int,
    position: Vector,
    velocity: Vector,
    q: Vector,
    latitude_deg: float,
    longitude_deg: float,
    altitude_m: float,
    home_altitude_m: float,
) -> Values:
    """Return GLOBAL_POSITION_INT of a local position; latitude .. altitude are the origin's."""
    origin = Geodetic(latitude_deg, longitude_deg, altitude_m)
    here = local_to_geodetic(position, origin)
    return (
        units.boot_ms(time_us),
        units.deg_e7(here.latitude_deg),
        units.deg_e7(here.longitude_deg),
        units.mm(here.altitude_m),
        units.mm(here.altitude_m - home_altitude_m),
        units.cm_s(velocity[0]),
        units.cm_s(velocity[1]),
        units.cm_s(velocity[2]),
        units.centidegrees(yaw_of((q[0], q[1], q[2], q[3]))),
    )


@kernel
def _ignored(position: Vector, velocity: Vector) -> int:
    """Return the POSITION_TARGET_TYPEMASK of a setpoint: what is not commanded."""
    mask = 0
    for i in range(3):  # the bits of y and z follow that of x
        if not math.isfinite(position[i]):
            mask |= dialect.POSITION_TARGET_TYPEMASK_X_IGNORE << i
        if not math.isfinite(velocity[i]):
            mask |= dialect.POSITION_TARGET_TYPEMASK_VX_IGNORE << i
    return mask


def _acceleration(state: AutopilotState) -> Vec:
    """Return the acceleration NED [m/s²] that the thrust setpoint stands for, gravity apart."""
    w, x, y, z = state.attitude_setpoint.tolist()
    north, east, down = rotate((w, x, y, z), (0.0, 0.0, state.thrust_setpoint / state.hover_thrust))
    return -GRAVITY_M_S2 * north, -GRAVITY_M_S2 * east, GRAVITY_M_S2 * (1.0 - down)


def _heading(yaw: float) -> Values:
    """Return a level attitude w, x, y, z with a heading [rad]."""
    return math.cos(0.5 * yaw), 0.0, 0.0, math.sin(0.5 * yaw)


def _height_above_home(state: AutopilotState) -> float:
    """Height above home [m]; above the local origin while either is unknown."""
    up = -float(state.estimate.position[2])
    if state.home is None or state.origin is None:
        return up
    return up + state.origin.altitude_m - state.home.altitude_m
