"""Vehicle status: identity, heartbeat, modes, health, estimator, mission, home, orbit, times.

Sources: PX4 1.16, src/lib/modes, src/modules/mavlink/streams/*.hpp (AVAILABLE_MODES, CURRENT_MODE,
HEARTBEAT, AUTOPILOT_STATE_FOR_GIMBAL_DEVICE), src/modules/commander/px4_custom_mode.h, and the
messages of a running PX4.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from airl_mav.core import addons, frames
from firmware_sim.autopilot import flight_modes
from firmware_sim.autopilot.autopilot_state import Arming, CommanderStatus, Landed
from firmware_sim.autopilot.modes.return_to_launch import return_time_s
from firmware_sim.autopilot.snapshot import AutopilotState
from firmware_sim.interfaces import TrueState
from firmware_sim.mavlink.codec import Values, dialect
from firmware_sim.mavlink.streams import units

CAPABILITIES: int = (
    dialect.MAV_PROTOCOL_CAPABILITY_PARAM_FLOAT
    | dialect.MAV_PROTOCOL_CAPABILITY_COMMAND_INT
    | dialect.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_BYTEWISE
    | dialect.MAV_PROTOCOL_CAPABILITY_SET_ATTITUDE_TARGET
    | dialect.MAV_PROTOCOL_CAPABILITY_SET_POSITION_TARGET_LOCAL_NED
    | dialect.MAV_PROTOCOL_CAPABILITY_FLIGHT_TERMINATION
    | dialect.MAV_PROTOCOL_CAPABILITY_MAVLINK2
    | dialect.MAV_PROTOCOL_CAPABILITY_MISSION_FLOAT
    | dialect.MAV_PROTOCOL_CAPABILITY_MISSION_INT
    | dialect.MAV_PROTOCOL_CAPABILITY_MISSION_FENCE
    | dialect.MAV_PROTOCOL_CAPABILITY_MISSION_RALLY
    | sum(addons.entries("firmware_sim", "CAPABILITIES").values())
)
"""Capabilities, with all add-ons equal to a real PX4's 0xE8FF."""

_BOARD_VERSION = 1
"""Board version, as in PX4 SITL."""

_CUSTOM_VERSION = b"airl-mav"
"""Custom version, in place of the first 8 bytes of a real PX4's git hash."""

UID = 0x4149_524C_4D41_5601
"""Constant hardware id, identical for all emulated vehicles."""

_MAVLINK_VERSION = 3
"""HEARTBEAT.mavlink_version of all MAVLink 1 and 2 systems."""

NO_MISSION = 0xFFFF
"""MISSION_CURRENT.total and HIGH_LATENCY2.wp_num without a stored mission."""

_LANDED = {
    Landed.ON_GROUND: dialect.MAV_LANDED_STATE_ON_GROUND,
    Landed.IN_AIR: dialect.MAV_LANDED_STATE_IN_AIR,
    Landed.TAKEOFF: dialect.MAV_LANDED_STATE_TAKEOFF,
    Landed.LANDING: dialect.MAV_LANDED_STATE_LANDING,
}

_NEVER_WRONG = (
    dialect.MAV_SYS_STATUS_SENSOR_DIFFERENTIAL_PRESSURE
    | dialect.MAV_SYS_STATUS_SENSOR_MOTOR_OUTPUTS
    | dialect.MAV_SYS_STATUS_LOGGING
    | dialect.MAV_SYS_STATUS_OBSTACLE_AVOIDANCE
)
_PRESENT = (
    dialect.MAV_SYS_STATUS_SENSOR_3D_GYRO
    | dialect.MAV_SYS_STATUS_SENSOR_3D_MAG
    | dialect.MAV_SYS_STATUS_SENSOR_ABSOLUTE_PRESSURE
    | dialect.MAV_SYS_STATUS_SENSOR_GPS
    | dialect.MAV_SYS_STATUS_SENSOR_XY_POSITION_CONTROL
    | dialect.MAV_SYS_STATUS_SENSOR_MOTOR_OUTPUTS
    | dialect.MAV_SYS_STATUS_SENSOR_BATTERY
)
"""Sensors present in a running PX4 1.16 SITL, which omits the accelerometer."""

_LOGGED = dialect.MAV_SYS_STATUS_LOGGING
"""Bit that is set after arming, when logging starts."""

_AUXILIARY = 6
_ALL_AUXILIARY = 0b1111_1100
"""MANUAL_CONTROL.enabled_extensions: PX4 has six auxiliary axes, constant here."""

_RADIO = dialect.MAV_SYS_STATUS_SENSOR_RC_RECEIVER
_RANGES = dialect.MAV_SYS_STATUS_SENSOR_LASER_POSITION


def heartbeat(state: AutopilotState) -> Values:
    """Return the vehicle type (PX4 quadrotor), mode and status."""
    status = state.status
    return (
        dialect.MAV_TYPE_QUADROTOR,
        dialect.MAV_AUTOPILOT_PX4,
        base_mode(status),
        status.mode.spec.custom_mode,
        system_status(status, can_arm=state.health.armable),
        _MAVLINK_VERSION,
    )


def manual_control(state: AutopilotState, system_id: int) -> Values | None:
    """Return the pilot's sticks [1e-3], throttle from -1000 as in PX4; None without input."""
    sticks = state.sticks
    if sticks is None:
        return None
    buttons = more_buttons = no_axis = 0
    return (
        system_id,
        *(
            units.int16(share * 1e3)
            # The wire order is x (pitch), y (roll), z (throttle), r (yaw).
            for share in (sticks.pitch, sticks.roll, sticks.throttle, sticks.yaw)
        ),
        *(buttons, more_buttons, _ALL_AUXILIARY, no_axis, no_axis),
        *(0,) * _AUXILIARY,
    )


def extended_sys_state(state: AutopilotState) -> Values:
    """Return the landed state. The vehicle is not a VTOL."""
    return dialect.MAV_VTOL_STATE_UNDEFINED, _LANDED[state.status.landed]


def sensor_bits(state: AutopilotState) -> tuple[int, int, int]:
    """Return the bits of SYS_STATUS: present, enabled, healthy.

    Source: PX4 1.16, streams/SYS_STATUS.hpp: a part is enabled when it is present or unhealthy.
    """
    present: int = _PRESENT
    # PX4 starts logging when it arms.
    if state.status.arming is Arming.ARMED:
        present |= _LOGGED
    if state.sticks is not None:
        present |= _RADIO
    if state.health.distance is not None:
        present |= _RANGES
    healthy: int = _NEVER_WRONG
    unhealthy: int = 0
    # A part is healthy or unhealthy; absent parts appear in neither set.
    for good, bit in _health(state):
        if good:
            healthy |= bit
        else:
            unhealthy |= bit
    if _may_be_armed(state):
        healthy |= dialect.MAV_SYS_STATUS_PREARM_CHECK
    return present, present | unhealthy, healthy


def _health(state: AutopilotState) -> Sequence[tuple[bool, int]]:
    """Return the health and SYS_STATUS bit of each part that can fail."""
    health = state.health
    # GPS counts as healthy only with a 3D fix.
    fixed = state.gps is not None and state.gps.fix_type >= dialect.GPS_FIX_TYPE_3D_FIX
    known = _knows(state)
    attitude = health.attitude and known
    parts = [
        (health.gyro, dialect.MAV_SYS_STATUS_SENSOR_3D_GYRO),
        (health.accel, dialect.MAV_SYS_STATUS_SENSOR_3D_ACCEL),
        # An all-zero field means that no compass sample has arrived.
        (health.mag and bool(state.mag.any()), dialect.MAV_SYS_STATUS_SENSOR_3D_MAG),
        (
            health.baro and state.pressure_hpa > 0.0,
            dialect.MAV_SYS_STATUS_SENSOR_ABSOLUTE_PRESSURE,
        ),
        (health.gps and fixed, dialect.MAV_SYS_STATUS_SENSOR_GPS),
        (attitude, dialect.MAV_SYS_STATUS_AHRS),
        (attitude, dialect.MAV_SYS_STATUS_SENSOR_ATTITUDE_STABILIZATION),
        (health.position and known, dialect.MAV_SYS_STATUS_SENSOR_XY_POSITION_CONTROL),
        (health.battery, dialect.MAV_SYS_STATUS_SENSOR_BATTERY),
        (state.sticks is not None, _RADIO),
    ]
    if health.distance is not None:
        parts.append((health.distance, _RANGES))
    return parts


def estimator_status(state: AutopilotState) -> Values:
    """Return output flags, innovation test ratios (1 = rejection gate), accuracies [m]."""
    estimate = state.estimate
    # Before the estimator converges, no output is valid.
    flags = _estimator_flags(state) if _knows(state) else 0
    horizontal, height, mag, vertical = estimate.innovation_ratio.tolist()
    north, east, down = estimate.sigma[:3].tolist()
    airspeed, ground = math.nan, state.clearance
    terrain = math.nan if ground is None else ground.ratio
    # The velocity ratio is the larger of both directions.
    ratios = (max(horizontal, vertical), horizontal, height, mag, terrain, airspeed)
    return estimate.time_us, flags, *ratios, math.hypot(north, east), down


def _knows(state: AutopilotState) -> bool:
    """Return True if the estimator has converged. Always True when armed."""
    return state.estimate.healthy or state.status.arming is Arming.ARMED


def _may_be_armed(state: AutopilotState) -> bool:
    """Return True if the pre-arm checks pass. Always True when armed."""
    arming = state.status.arming
    return arming is Arming.ARMED or (state.health.armable and arming is Arming.STANDBY)


def _estimator_flags(state: AutopilotState) -> int:
    """Return the flags of a converged estimator."""
    health, known = state.health, state.origin is not None
    above_ground = state.clearance is not None and state.clearance.valid
    # A disarmed vehicle is assumed stationary.
    stationary = state.status.arming is not Arming.ARMED
    relative = dialect.ESTIMATOR_POS_HORIZ_REL | dialect.ESTIMATOR_PRED_POS_HORIZ_REL
    absolute = dialect.ESTIMATOR_POS_HORIZ_ABS | dialect.ESTIMATOR_PRED_POS_HORIZ_ABS
    flags = (
        (health.attitude, dialect.ESTIMATOR_ATTITUDE),
        (health.velocity, dialect.ESTIMATOR_VELOCITY_HORIZ),
        (health.altitude, dialect.ESTIMATOR_VELOCITY_VERT | dialect.ESTIMATOR_POS_VERT_ABS),
        (health.position, relative),
        (health.position and known, absolute),
        (bool(state.estimate.innovation_ratio[0] > 1.0), dialect.ESTIMATOR_GPS_GLITCH),
        (health.accel_error, dialect.ESTIMATOR_ACCEL_ERROR),
        (above_ground, dialect.ESTIMATOR_POS_VERT_AGL),
        (stationary, dialect.ESTIMATOR_CONST_POS_MODE),
    )
    return sum([bits for is_set, bits in flags if is_set])


def mission_current(state: AutopilotState) -> Values:
    """Return the current item, the number of items, and the ids of stored lists, as in PX4."""
    mission = state.mission
    total = mission.total or NO_MISSION
    ids = (mission.mission_id, mission.fence_id, mission.rally_points_id)
    return mission.current, total, mission.state, mission.mode, *ids


def autopilot_version(version: int) -> Values:
    """Return identity, `flight_sw_version` and actual capabilities of the built-in autopilot."""
    os_version = vendor = product = 0
    middleware_custom_version = os_custom_version = (0,) * 8
    return (
        CAPABILITIES,
        *(version, version, os_version, _BOARD_VERSION),
        *(*_CUSTOM_VERSION, *middleware_custom_version, *os_custom_version),
        *(vendor, product, UID),
    )


def system_time(state: AutopilotState, boot_unix_us: int) -> Values:
    """Return the present time [µs since 1970, UTC], given that of boot, and the time since boot."""
    return boot_unix_us + state.time_us, units.boot_ms(state.time_us)


_ALL = 0
"""Target id of a broadcast."""
_NO_DELAY_US = 0


def autopilot_state_for_gimbal_device(state: AutopilotState) -> Values:
    """Return attitude, velocity and yaw rate for gimbal stabilization.

    As in PX4, this message has two landed states and no delays.
    """
    estimate = state.estimate
    landed = state.status.landed is Landed.ON_GROUND
    yaw_rate = state.setpoint.yaw_rate
    return (
        _ALL,
        _ALL,
        estimate.time_us,
        *estimate.quaternion.tolist(),
        _NO_DELAY_US,
        *estimate.velocity.tolist(),
        _NO_DELAY_US,
        0.0 if math.isnan(yaw_rate) else yaw_rate,
        estimator_status(state)[1],
        dialect.MAV_LANDED_STATE_ON_GROUND if landed else dialect.MAV_LANDED_STATE_IN_AIR,
    )


_NO_AIRSPEEDS = (0, 0)

_UNKNOWN_TIME = -1
"""Value of unknown times: PX4 estimates only the return time."""


def time_estimate_to_target(state: AutopilotState, value: Callable[[str], float]) -> Values | None:
    """Return the duration of a safe return [s]; 0 on the ground, None without home.

    `value` returns the current value of a PX4 parameter by name.
    """
    home, origin = state.home, state.origin
    if home is None or origin is None:
        return None
    took = 0.0
    # On the ground the return takes no time.
    if state.status.landed is not Landed.ON_GROUND:
        target = frames.geodetic_to_local(home, origin).tolist()
        north, east, down = (
            b - a for a, b in zip(target, state.estimate.position.tolist(), strict=True)
        )
        took = return_time_s(value, -down, math.hypot(north, east))
    unknown = (_UNKNOWN_TIME,) * 4
    return int(took) if math.isfinite(took) else _UNKNOWN_TIME, *unknown


def current_mode(state: AutopilotState) -> Values:
    """Return the active mode and the mode requested by the user."""
    active, intended = state.status.mode.spec, state.status.intended_mode.spec
    return intended.standard, active.custom_mode, intended.custom_mode


_NO_APPROACH = (0.0, 0.0, 0.0)
"""Approach vector of HOME_POSITION: no special approach."""


def orbit_execution_status(state: AutopilotState) -> Values | None:
    """Return the current orbit, with its global centre; None in other modes."""
    orbit, origin = state.orbit, state.origin
    if orbit is None or origin is None:
        return None
    centre = frames.local_to_geodetic(np.array(orbit.centre), origin)
    return (
        state.time_us,
        orbit.radius_m,
        dialect.MAV_FRAME_GLOBAL,
        units.deg_e7(centre.latitude_deg),
        units.deg_e7(centre.longitude_deg),
        centre.altitude_m,
    )


def home_position(state: AutopilotState) -> Values | None:
    """Return home in global coordinates and in local NED; None if unset."""
    home, origin = state.home, state.origin
    if home is None:
        return None
    # Without an origin the home position has no local coordinates.
    local = (
        [math.nan, math.nan, math.nan]
        if origin is None
        else frames.geodetic_to_local(home, origin).tolist()
    )
    return *_wire(home), *local, *_level(state.home_yaw), *_NO_APPROACH, state.time_us


def gps_global_origin(state: AutopilotState) -> Values | None:
    """Return the origin of local NED in global coordinates; None if unset."""
    return None if state.origin is None else (*_wire(state.origin), state.time_us)


def _wire(place: frames.Geodetic) -> Values:
    """Return latitude, longitude [degE7] and altitude [mm]."""
    return (
        units.deg_e7(place.latitude_deg),
        units.deg_e7(place.longitude_deg),
        units.mm(place.altitude_m),
    )


def _level(yaw: float) -> Values:
    """Return a level attitude w, x, y, z with a heading [rad]."""
    return math.cos(0.5 * yaw), 0.0, 0.0, math.sin(0.5 * yaw)


# HIL_STATE_QUATERNION is sent on request only, as PX4 SITL sends its simulator's state. Real
# firmware receives it from the same function. No flight code reads it. Source: PX4 1.16,
# streams/HIL_STATE_QUATERNION.hpp.


_NO_ACCELERATION = (0, 0, 0)
"""Placeholder: `TrueState` has no acceleration, and PX4 only logs it."""


def hil_state_quaternion(truth: TrueState, time_us: int) -> Values:
    """Return attitude (w, x, y, z, body -> NED), rates [rad/s], position and velocity [cm/s].

    Args:
        truth: True state.
        time_us: Time stamp on the receiver's clock [µs].
    """
    place = frames.local_to_geodetic(truth.position, frames.HOME)
    return (
        time_us,
        *truth.quaternion.tolist(),
        *truth.angular_velocity.tolist(),
        units.deg_e7(place.latitude_deg),
        units.deg_e7(place.longitude_deg),
        units.mm(place.altitude_m),
        *(units.cm_s(v) for v in truth.velocity.tolist()),
        *_NO_AIRSPEEDS,
        *_NO_ACCELERATION,
    )


def base_mode(status: CommanderStatus) -> int:
    """Return the MAV_MODE_FLAG bits of HEARTBEAT."""
    bits: int = dialect.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
    if status.mode.spec.stabilized:
        bits |= dialect.MAV_MODE_FLAG_STABILIZE_ENABLED
    if status.mode.spec.main == flight_modes.MAIN_AUTO:
        bits |= dialect.MAV_MODE_FLAG_AUTO_ENABLED | dialect.MAV_MODE_FLAG_GUIDED_ENABLED
    if status.mode in flight_modes.WITH_STICKS:
        bits |= dialect.MAV_MODE_FLAG_MANUAL_INPUT_ENABLED
    if status.arming is Arming.ARMED:
        bits |= dialect.MAV_MODE_FLAG_SAFETY_ARMED
    return bits


def system_status(status: CommanderStatus, *, can_arm: bool) -> int:
    """Return the MAV_STATE of HEARTBEAT.

    Armed: ACTIVE, or CRITICAL in a failsafe. Disarmed: STANDBY, or UNINIT if the mode cannot be
    armed. After a termination: FLIGHT_TERMINATION, armed or not.
    """
    if status.mode is flight_modes.Mode.TERMINATION:
        return int(dialect.MAV_STATE_FLIGHT_TERMINATION)
    if status.arming is Arming.ARMED:
        # ACTIVE or CRITICAL applies only to an armed vehicle.
        return int(dialect.MAV_STATE_CRITICAL if status.failsafe else dialect.MAV_STATE_ACTIVE)
    standby = status.arming is Arming.STANDBY and can_arm
    return int(dialect.MAV_STATE_STANDBY if standby else dialect.MAV_STATE_UNINIT)
