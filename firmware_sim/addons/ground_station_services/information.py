"""Messages on request: flight times, modes, outputs, fence, IMU, and a summary for satellite links.

Also REQUEST_DATA_STREAM, the predecessor of SET_MESSAGE_INTERVAL, and the answers to commands and
rates without effect.
Sources: PX4 1.16, src/modules/mavlink/streams/*.hpp (HIGH_LATENCY2, AVAILABLE_MODES), and the
messages of a running PX4.
"""

from __future__ import annotations

import math

from airl_mav.core.constants import GRAVITY_M_S2, US_PER_S
from airl_mav.core.frames import local_to_geodetic, quat_yaw
from firmware_sim.autopilot import flight_modes
from firmware_sim.autopilot.autopilot_state import Arming, OperatorText, Result, Severity
from firmware_sim.autopilot.events import flight_events as events
from firmware_sim.autopilot.snapshot import AutopilotState
from firmware_sim.mavlink import message_rates, services
from firmware_sim.mavlink.codec import Values, WireMessage, dialect
from firmware_sim.mavlink.streams import Builder, no_content, sensors, units
from firmware_sim.mavlink.streams.status import NO_MISSION, base_mode


def fence_status(state: AutopilotState) -> Values:
    """Return geofence breaches. PX4 has no such stream; sent on request only."""
    fence = state.fence
    kind = dialect.FENCE_BREACH_NONE
    # Distance and custom fences are boundaries; MAVLink has no separate type for a custom fence.
    if fence.distance or fence.custom:
        kind = dialect.FENCE_BREACH_BOUNDARY
    elif fence.altitude:
        kind = dialect.FENCE_BREACH_MAXALT
    breached = int(any(fence.breached))
    return breached, units.uint16(fence.breaches), kind, units.boot_ms(fence.time_us)


_UINT8_MAX, _INT8_MIN = 255, -128
_UNKNOWN_I8 = (_INT8_MIN,) * 3


def high_latency2(state: AutopilotState) -> Values:
    """Return position, headings, speeds, charge and failures for HIGH_LATENCY2.

    Units: [1e-7 deg, m], [2 deg], [0.2 m/s, 0.1 m/s], [%]. PX4 sends the mean or the maximum since
    the last message; here it is the current value.
    """
    estimate, gps = state.estimate, state.gps
    north, east, down = estimate.velocity.tolist()
    armed = state.status.arming is Arming.ARMED
    # PX4 sends a target for fixed-wing vehicles only; airspeeds and wind are unknown.
    target_altitude = target_distance = airspeed = airspeed_setpoint = wind = wind_heading = 0
    return (
        units.boot_ms(state.time_us),
        dialect.MAV_TYPE_QUADROTOR,
        dialect.MAV_AUTOPILOT_PX4,
        # The message has room for main and sub mode only: the upper 16 bits of custom_mode.
        state.status.mode.spec.custom_mode >> 16,
        *(*_place(state), target_altitude),
        *(_heading(quat_yaw(estimate.quaternion)), _heading(quat_yaw(state.attitude_setpoint))),
        target_distance,
        units.percent(state.thrust_setpoint) if armed else 0,
        *(airspeed, airspeed_setpoint),
        # The unit of speed is 0.2 m/s, hence the factor 5.
        _uint8(math.hypot(north, east) * 5.0),
        *(wind, wind_heading),
        *((_UINT8_MAX,) * 2 if gps is None else (_uint8(gps.eph_m * 10), _uint8(gps.epv_m * 10))),
        _INT8_MIN,  # unknown temperature
        # The climb rate has no sign here: [0.1 m/s] in one byte.
        units.saturate(abs(down) * 10.0, 0, 127, 0),
        units.percent(state.battery.remaining),
        state.mission.current if state.mission.total else NO_MISSION,
        _failures(state),
        *_UNKNOWN_I8,
    )


def _place(state: AutopilotState) -> tuple[int, int, int]:
    """Return latitude, longitude [1e-7 deg] and altitude [m]; zeros if unknown."""
    position = state.estimate.position
    if state.origin is None or not all(map(math.isfinite, position.tolist())):
        return 0, 0, 0
    place = local_to_geodetic(position, state.origin)
    return (
        units.deg_e7(place.latitude_deg),
        units.deg_e7(place.longitude_deg),
        units.int16(place.altitude_m),
    )


def _heading(yaw_rad: float) -> int:
    """Return a heading in units of 2 deg."""
    return int(math.degrees(yaw_rad % units.TWO_PI) / 2.0) if math.isfinite(yaw_rad) else 0


def _uint8(value: float) -> int:
    return units.saturate(value, 0, _UINT8_MAX, _UINT8_MAX)


def _failures(state: AutopilotState) -> int:
    """Return the HL_FAILURE_FLAG bits of failed parts."""
    health, status = state.health, state.status
    # Offboard counts as lost when the failsafe replaces the intended mode.
    offboard_lost = status.failsafe and status.intended_mode is flight_modes.Mode.OFFBOARD
    failed = {
        dialect.HL_FAILURE_FLAG_GPS: not health.gps,
        dialect.HL_FAILURE_FLAG_ABSOLUTE_PRESSURE: not health.baro,
        dialect.HL_FAILURE_FLAG_3D_ACCEL: not health.accel,
        dialect.HL_FAILURE_FLAG_3D_GYRO: not health.gyro,
        dialect.HL_FAILURE_FLAG_3D_MAG: not health.mag,
        dialect.HL_FAILURE_FLAG_BATTERY: not health.battery,
        dialect.HL_FAILURE_FLAG_RC_RECEIVER: state.sticks is None,
        dialect.HL_FAILURE_FLAG_OFFBOARD_LINK: offboard_lost,
        dialect.HL_FAILURE_FLAG_GEOFENCE: any(state.fence.breached),
        dialect.HL_FAILURE_FLAG_ESTIMATOR: not (health.attitude and health.position),
    }
    return sum(bit for bit, has_failed in failed.items() if has_failed)


def flight_information(state: AutopilotState) -> Values:
    """Return the times of arming and takeoff [µs since boot]; 0 while disarmed."""
    flight_uuid = landing_time = 0
    armed, took_off = state.armed_us, state.takeoff_us
    return units.boot_ms(state.time_us), armed, took_off, flight_uuid, landing_time


def protocol_version(state: AutopilotState) -> Values:  # noqa: ARG001 - a builder
    """Return the sent, minimum and maximum version: 2.0 is sent, 1.0 accepted, as in PX4."""
    sent, minimum, maximum, no_hash = 200, 100, 200, (0,) * 8
    return sent, minimum, maximum, *no_hash, *no_hash


AVAILABLE = tuple(sorted(flight_modes.BY_CUSTOM_MODE.values(), key=lambda mode: mode.spec.state))
"""Modes as clients distinguish them, in the order of AVAILABLE_MODES."""


def available_modes() -> list[tuple[int, int, int, int, int, bytes]]:
    """Return the fields of AVAILABLE_MODES for each mode, in order."""
    # The count and the number of each mode, starting at 1, in every message.
    return [
        (len(AVAILABLE), number, spec.standard, spec.custom_mode, _properties(spec), name)
        for number, spec in enumerate((mode.spec for mode in AVAILABLE), start=1)
        # A standard mode implies its name.
        for name in (b"" if spec.standard else spec.title.encode("ascii"),)
    ]


def _properties(spec: flight_modes.ModeSpec) -> int:
    """Return the bits of MAV_MODE_PROPERTY."""
    advanced: int = dialect.MAV_MODE_PROPERTY_ADVANCED if spec.advanced else 0
    hidden: int = 0 if spec.requestable else dialect.MAV_MODE_PROPERTY_NOT_USER_SELECTABLE
    return advanced | hidden


def scaled_imu(state: AutopilotState) -> Values:
    """Return the newest IMU sample without biases [mG, mrad/s], and magnetic field [mGauss]."""
    estimate = state.estimate
    return (
        units.boot_ms(state.time_us),
        *(
            # m/s² to milli-g, rad/s to mrad/s, gauss to milligauss.
            units.int16(a * 1e3 / GRAVITY_M_S2)
            for a in (state.accel - estimate.accel_bias).tolist()
        ),
        *(units.int16(w * 1e3) for w in (state.gyro - estimate.gyro_bias).tolist()),
        *(units.int16(m * 1e3) for m in state.mag.tolist()),
        units.int16(state.temperature_c * 100.0),
    )


_PWM_DISARMED, _PWM_MIN, _PWM_SPAN = 900, 1_000, 1_000
"""Pulse widths [µs] of PX4's simulated outputs (src/modules/simulation/pwm_out_sim)."""

_OUTPUTS = 16
"""Number of outputs in PX4's simulation. Outputs without a motor stay at the disarmed pulse."""

_OUTPUT_FIELDS = 32
"""Number of slots in ACTUATOR_OUTPUT_STATUS."""


def actuator_output_status(state: AutopilotState) -> Values:
    """Return the pulse widths [µs] as an array with 16 active outputs."""
    return state.time_us, _OUTPUTS, *_outputs(state), *(0,) * (_OUTPUT_FIELDS - _OUTPUTS)


def hil_actuator_controls(state: AutopilotState) -> Values:
    """Return motor commands 0..1, zero while disarmed; 16 controls."""
    commands, flags = _commands(state), 0
    unused = (0.0,) * (_OUTPUTS - len(commands))
    return state.time_us, *commands, *unused, base_mode(state.status), flags


def _outputs(state: AutopilotState) -> Values:
    """Return the pulse widths of all outputs [µs]."""
    pulses = _pulses(state)
    return *pulses, *(_PWM_DISARMED,) * (_OUTPUTS - len(pulses))


def _armed(state: AutopilotState) -> bool:
    return state.status.arming is Arming.ARMED


def _commands(state: AutopilotState) -> tuple[float, ...]:
    return state.motors if _armed(state) else (0.0,) * len(state.motors)


def _pulses(state: AutopilotState) -> list[int]:
    if not _armed(state):
        return [_PWM_DISARMED] * len(state.motors)
    return [_PWM_MIN + units.saturate(_PWM_SPAN * u, 0, _PWM_SPAN, 0) for u in state.motors]


GROUPS: dict[int, tuple[str, ...]] = {
    dialect.MAV_DATA_STREAM_RAW_SENSORS: ("HIGHRES_IMU", "SCALED_PRESSURE", "GPS_RAW_INT"),
    dialect.MAV_DATA_STREAM_EXTENDED_STATUS: (
        "SYS_STATUS",
        "EXTENDED_SYS_STATE",
        "MISSION_CURRENT",
        "BATTERY_STATUS",
    ),
    dialect.MAV_DATA_STREAM_RC_CHANNELS: ("SERVO_OUTPUT_RAW",),
    dialect.MAV_DATA_STREAM_RAW_CONTROLLER: ("ATTITUDE_TARGET", "POSITION_TARGET_LOCAL_NED"),
    dialect.MAV_DATA_STREAM_POSITION: ("LOCAL_POSITION_NED", "GLOBAL_POSITION_INT"),
    dialect.MAV_DATA_STREAM_EXTRA1: ("ATTITUDE",),
    dialect.MAV_DATA_STREAM_EXTRA2: ("VFR_HUD",),
    dialect.MAV_DATA_STREAM_EXTRA3: ("SYSTEM_TIME", "ESTIMATOR_STATUS", "VIBRATION"),
}
"""Streams of the groups of REQUEST_DATA_STREAM."""


def _request_modes(command: services.VehicleCommand, context: services.Context) -> Result:
    """Handle parameter 2: number of the mode, starting at 1; 0 = all."""
    number = command.integer(2) or 0
    modes = available_modes()
    if not 0 <= number <= len(modes):
        return Result.DENIED
    # Modes are numbered from 1.
    for fields in modes if number == 0 else modes[number - 1 : number]:
        context.link.send(dialect.MAVLink_available_modes_message(*fields))
    return Result.ACCEPTED


def handle_data_stream(message: WireMessage, context: services.Context) -> bool:
    """Handle REQUEST_DATA_STREAM: raise the rates of a stream group, or restore the defaults.

    A real PX4 ignores this deprecated message. Here it can only raise rates: MAVProxy requests all
    streams at 4 Hz when it connects, and another client on the same link must keep its 100 Hz
    attitude.
    """
    if message.req_stream_id == dialect.MAV_DATA_STREAM_ALL:
        names = tuple(name for group in GROUPS.values() for name in group)
    else:
        names = GROUPS.get(message.req_stream_id, ())
    scheduler = context.link.scheduler
    start = message.start_stop == 1 and message.req_message_rate > 0
    for name in names:
        if not start:
            scheduler.set_interval(name, scheduler.default_us(name), context.now_us)
            continue
        requested_us = US_PER_S // message.req_message_rate
        present_us = scheduler.interval_us(name)
        # Only a shorter interval is set: a request must not slow another client's stream.
        if present_us == message_rates.OFF or max(requested_us, 1) < present_us:
            scheduler.set_interval(name, max(requested_us, 1), context.now_us)
    return bool(names)


HANDLERS: services.Handlers = {
    "REQUEST_DATA_STREAM": (services.for_vehicle_or_all, handle_data_stream)
}

REQUESTS: dict[int, services.Action] = {dialect.MAVLINK_MSG_ID_AVAILABLE_MODES: _request_modes}

SILENT = (
    *("GPS_STATUS", "NAV_CONTROLLER_OUTPUT", "COMMAND_LONG"),
    *("CAMERA_TRIGGER", "SCALED_IMU2", "SCALED_IMU3", "GPS2_RAW"),
    *("SCALED_PRESSURE3", "LANDING_TARGET", "EFI_STATUS", "WIND_COV"),
    *("GPS_RTCM_DATA", "ADSB_VEHICLE", "DEBUG_VECT", "NAMED_VALUE_FLOAT"),
    *("STATUSTEXT", "DEBUG", "CAMERA_IMAGE_CAPTURED", "MOUNT_ORIENTATION"),
    *("GIMBAL_MANAGER_INFORMATION", "GIMBAL_MANAGER_STATUS", "GIMBAL_DEVICE_INFORMATION"),
    *("GIMBAL_DEVICE_SET_ATTITUDE", "GIMBAL_DEVICE_ATTITUDE_STATUS"),
    *("OBSTACLE_DISTANCE", "RAW_RPM", "DEBUG_FLOAT_ARRAY", "FIGURE_EIGHT_EXECUTION_STATUS"),
    *("OPEN_DRONE_ID_BASIC_ID", "OPEN_DRONE_ID_LOCATION", "OPEN_DRONE_ID_SYSTEM"),
)
"""Streams of PX4 without content here, because the vehicle lacks the device.

A real PX4 accepts a rate for these streams and sends nothing, as does this simulator. Source: the
ids accepted by SET_MESSAGE_INTERVAL on a running PX4 1.16."""

BUILDERS: dict[str, Builder] = {
    **dict.fromkeys(SILENT, no_content),
    "FENCE_STATUS": fence_status,
    "ACTUATOR_OUTPUT_STATUS": actuator_output_status,
    "HIL_ACTUATOR_CONTROLS": hil_actuator_controls,
    "SCALED_IMU": scaled_imu,
    # PX4's simulator sends one measurement to two barometers.
    "SCALED_PRESSURE2": sensors.scaled_pressure,
    "FLIGHT_INFORMATION": flight_information,
    "PROTOCOL_VERSION": protocol_version,
    "HIGH_LATENCY2": high_latency2,
}


ACCEPTED = (
    dialect.MAV_CMD_DO_SET_ACTUATOR,
    dialect.MAV_CMD_DO_GO_AROUND,
    dialect.MAV_CMD_EXTERNAL_WIND_ESTIMATE,
)


NOT_ACKNOWLEDGED = [
    int(getattr(dialect, f"MAV_CMD_{name}"))
    for name in (
        *("CONFIGURE_ACTUATOR", "DO_FIGURE_EIGHT", "DO_SET_CAM_TRIGG_DIST"),
        *("DO_SET_CAM_TRIGG_INTERVAL", "OBLIQUE_SURVEY", "SET_CAMERA_ZOOM"),
        *("SET_CAMERA_FOCUS", "START_RX_PAIR", "SET_CAMERA_MODE", "DO_DIGICAM_CONTROL"),
        *("DO_TRIGGER_CONTROL", "DO_GRIPPER", "DO_WINCH", "DO_MOUNT_CONTROL"),
        *("DO_MOUNT_CONFIGURE", "DO_MOUNT_CONTROL_QUAT", "DO_GIMBAL_MANAGER_PITCHYAW"),
        *("DO_GIMBAL_MANAGER_CONFIGURE", "REQUEST_CAMERA_INFORMATION", "NAV_DELAY"),
        *("DO_VTOL_TRANSITION", "PREFLIGHT_SET_SENSOR_OFFSETS", "PREFLIGHT_UAVCAN"),
        *("PAYLOAD_PREPARE_DEPLOY", "PAYLOAD_CONTROL_DEPLOY"),
    )
]
"""Commands to parts that the vehicle lacks."""


def _answer(result: Result | None) -> services.Action:
    """Return an action without effect that returns this result."""
    return lambda _command, _context: result


def _actuator_test(_command: services.VehicleCommand, context: services.Context) -> Result | None:
    """Handle ACTUATOR_TEST: PX4 rejects it while armed; disarmed, it has no effect here."""
    armed = context.port.state().status.arming is Arming.ARMED
    return Result.DENIED if armed else None


def _high_latency(_command: services.VehicleCommand, context: services.Context) -> Result:
    context.announce(OperatorText.of(Severity.CRITICAL, events.NO_HIGH_LATENCY))
    return Result.FAILED


ACTIONS: dict[int, services.Action] = {
    **dict.fromkeys(ACCEPTED, _answer(Result.ACCEPTED)),
    **dict.fromkeys(NOT_ACKNOWLEDGED, _answer(None)),
    dialect.MAV_CMD_ACTUATOR_TEST: _actuator_test,
    dialect.MAV_CMD_CONTROL_HIGH_LATENCY: _high_latency,
    # The estimator accepts an external position only while it has none.
    dialect.MAV_CMD_EXTERNAL_POSITION_ESTIMATE: _answer(Result.TEMPORARILY_REJECTED),
}
"""Commands without effect here, answered as by a running PX4 1.16 SITL."""
