"""COMMAND_LONG, COMMAND_INT and SET_MODE.

Replies and rejections follow PX4's Commander.cpp and mavlink_receiver.cpp, checked against a
running PX4 1.16. A command to the vehicle is acknowledged to its sender, on the same link. Clients
repeat commands, so actions are idempotent. Every service adds its actions (`ACTIONS`).
"""

from __future__ import annotations

import math
from dataclasses import replace
from operator import attrgetter

from airl_mav.core.frames import Geodetic, geodetic_to_local
from airl_mav.vehicle.rotation import Vec
from firmware_sim.autopilot.autopilot_state import OperatorText, Result, Severity
from firmware_sim.autopilot.events import flight_events as events
from firmware_sim.autopilot.events.definition import NavigationMode
from firmware_sim.autopilot.flight_modes import MAIN_AUTO, MAIN_POSCTL, Mode
from firmware_sim.autopilot.modes.interface import OrbitRequest, PositionYaw, Reposition
from firmware_sim.mavlink import codec, services
from firmware_sim.mavlink.streams.units import INT32_MAX

NAN = math.nan

_CHANGE_MODE: int = codec.dialect.MAV_DO_REPOSITION_FLAGS_CHANGE_MODE
_GROUND_SPEED: int = codec.dialect.SPEED_TYPE_GROUNDSPEED

_LOWEST_M, _HIGHEST_M = -12_000.0, 100_000.0
"""Range of valid origin altitudes above mean sea level, as in EKF2 [m]."""


def _reposition(command: services.VehicleCommand, context: services.Context) -> Result:
    """Handle parameters 1: speed [m/s], 2: flags, 4: heading [rad], 5..7: position; NaN = keep."""
    # PX4 1.16 supports DO_REPOSITION only with the change-mode flag.
    if command.integer(2) != _CHANGE_MODE:
        return Result.UNSUPPORTED
    speed, yaw = command.params[0], command.params[3]
    speed = speed if math.isfinite(speed) and speed > 0.0 else NAN
    place = PositionYaw(local_place(command, context), yaw if math.isfinite(yaw) else NAN)
    # A command without any value means: hold here.
    if all(map(math.isnan, (*place.position, place.yaw))):
        return context.port.set_mode(Mode.HOLD)
    return context.port.set_mode(Mode.HOLD, Reposition(place, speed))


def _change_altitude(command: services.VehicleCommand, context: services.Context) -> Result:
    """Handle parameter 1: altitude [m] above mean sea level."""
    nowhere = (NAN, NAN, NAN, NAN, NAN, NAN)
    above = replace(command, params=(*nowhere, command.params[0]))
    place = PositionYaw(local_place(above, context), NAN)
    return context.port.set_mode(Mode.HOLD, Reposition(place, altitude_alone=True))


def _change_speed(command: services.VehicleCommand, context: services.Context) -> Result:
    """Handle parameters 1: SPEED_TYPE, 2: speed [m/s]."""
    speed = command.params[1]
    if command.integer(1) == _GROUND_SPEED and speed > 0.0 and math.isfinite(speed):
        context.port.change_speed(speed)
    return Result.ACCEPTED


def _orbit(command: services.VehicleCommand, context: services.Context) -> Result:
    """Handle parameters 1: radius [m], 2: speed [m/s], 3: ORBIT_YAW_BEHAVIOUR, 5..7: centre."""
    radius, speed = (p if math.isfinite(p) else NAN for p in command.params[:2])
    request = OrbitRequest(local_place(command, context), radius, speed, command.integer(3))
    result = context.port.set_mode(Mode.ORBIT, request)
    if result is not Result.ACCEPTED:
        context.announce(OperatorText(Severity.CRITICAL, "Orbit command rejected"))
    return result


def local_place(command: services.VehicleCommand, context: services.Context) -> Vec:
    """Return parameters 5 to 7 in local NED [m]; NaN if unset or unknown."""
    latitude, longitude, altitude = command.params[4:]
    state = context.port.state()
    origin = state.origin
    if origin is None:
        return NAN, NAN, NAN
    # NED: down is positive, so the altitude changes sign.
    down = origin.altitude_m - altitude if math.isfinite(altitude) else NAN
    if not (math.isfinite(latitude) and math.isfinite(longitude)):
        return NAN, NAN, down
    # Only the horizontal part is used, so the altitude of this point does not matter.
    north, east, _ = geodetic_to_local(
        Geodetic(latitude, longitude, origin.altitude_m), origin
    ).tolist()
    return north, east, down


def _set_home(command: services.VehicleCommand, context: services.Context) -> Result:
    """Handle parameter 1: 1 = current position; otherwise parameters 5 to 7 are the position."""
    if command.params[0] > 0.5:
        return context.port.set_home(None)
    place = Geodetic(*command.params[4:7])
    if not all(math.isfinite(value) for value in place):
        return Result.DENIED
    return context.port.set_home(place)


def handle_set_origin(message: codec.WireMessage, context: services.Context) -> bool:
    """Handle SET_GPS_GLOBAL_ORIGIN: move the origin of local NED.

    Requires this system id and a valid position. Like PX4 1.16, always reply GPS_GLOBAL_ORIGIN.
    """
    meant: bool = message.target_system == context.system_id
    # The message has 1e-7 degrees and millimetres.
    place = Geodetic(message.latitude / 1e7, message.longitude / 1e7, message.altitude / 1e3)
    if meant and _is_on_the_globe(place):
        context.port.set_origin(place)
    context.link.send_stream("GPS_GLOBAL_ORIGIN", context.port.state())
    return meant


def _is_on_the_globe(place: Geodetic) -> bool:
    latitude, longitude, altitude = place
    return abs(latitude) <= 90.0 and abs(longitude) <= 180.0 and _LOWEST_M < altitude < _HIGHEST_M


FORCE_MAGIC = 21_196
"""Value of MAV_CMD_COMPONENT_ARM_DISARM param2 that skips the checks."""

TERMINATE_FROM = 0.5
"""Parameter 1 must exceed this value. Termination is irreversible (otherwise DENIED, as in PX4)."""

# Cached: names built per message would accumulate in the interpreter's attribute cache.
_PARAMS = attrgetter(*(f"param{number}" for number in range(1, 8)))

_RELATIVE_FRAMES = (
    codec.dialect.MAV_FRAME_GLOBAL_RELATIVE_ALT,
    codec.dialect.MAV_FRAME_GLOBAL_RELATIVE_ALT_INT,
)


def _arm_disarm(command: services.VehicleCommand, context: services.Context) -> Result | None:
    force = command.integer(2) == FORCE_MAGIC
    if command.integer(1) == 1:
        if any(state.forbids_arming for state in context.vehicle_states.values()):
            context.announce(OperatorText.of(Severity.CRITICAL, events.ARM_WHILE_CALIBRATING))
            return Result.TEMPORARILY_REJECTED
        return context.port.arm(force=force)
    if command.integer(1) == 0:
        return context.port.disarm(force=force)
    # Other values are an error with a text, without an acknowledgement, as in PX4.
    asked = command.params[0]
    text = f"Unsupported ARM_DISARM param: {asked:.3f}"
    context.announce(OperatorText.of(Severity.CRITICAL, events.ARM_PARAMETER, asked, text=text))
    return None


def _takeoff(command: services.VehicleCommand, context: services.Context) -> Result:
    """Handle NAV_TAKEOFF, parameters 5, 6: target; 7: altitude above mean sea level [m].

    In a relative frame the altitude is above home. NaN = vertical takeoff to MIS_TAKEOFF_ALT.
    """
    altitude, (north, east, _) = command.params[6], local_place(command, context)
    place = None if math.isnan(north) else (north, east)
    if not math.isfinite(altitude):
        return context.port.takeoff(None, place)
    if command.frame in _RELATIVE_FRAMES:
        return context.port.takeoff(altitude, place)
    # Without a home the altitude above sea level has no reference.
    home = context.port.state().home
    if home is None:
        return Result.TEMPORARILY_REJECTED
    return context.port.takeoff(altitude - home.altitude_m, place)


def _change_mode(base: int, main: int, sub: int, context: services.Context) -> Result:
    """Change the mode, given MAV_MODE_FLAG bits, PX4's main mode and sub mode."""
    request = requested_mode(base, main, sub)
    if isinstance(request, OperatorText):
        context.announce(request)
        return Result.TEMPORARILY_REJECTED
    if request is None:
        return Result[context.port.parameters.release.unknown_mode]
    return context.port.set_mode(request)


def _set_standard_mode(command: services.VehicleCommand, context: services.Context) -> Result:
    """Handle DO_SET_STANDARD_MODE, parameter 1: MAV_STANDARD_MODE; FAILED if unsupported."""
    asked, custom = command.integer(1) or 0, codec.dialect.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
    # NON_STANDARD is 0, also the value of an unset parameter.
    if asked != codec.dialect.MAV_STANDARD_MODE_NON_STANDARD:
        for mode in Mode:
            if mode.spec.standard == asked:
                return _change_mode(custom, mode.spec.main, mode.spec.sub, context)
    return Result.FAILED


def _set_mode(command: services.VehicleCommand, context: services.Context) -> Result:
    base, main, sub = (command.integer(number) or 0 for number in (1, 2, 3))
    return _change_mode(base, main, sub, context)


def _terminate(command: services.VehicleCommand, context: services.Context) -> Result:
    """Handle DO_FLIGHTTERMINATION: stop the motors permanently; DENIED unless armed (PX4)."""
    wanted = command.params[0] > TERMINATE_FROM
    return context.port.terminate() if wanted else Result.DENIED


def _run_checks(_command: services.VehicleCommand, context: services.Context) -> Result:
    """Handle RUN_PREARM_CHECKS: report the failed checks again."""
    context.port.tell_checks()
    return Result.ACCEPTED


def _reboot(command: services.VehicleCommand, _context: services.Context) -> Result:
    """Handle a reboot request: PX4 SITL accepts only "do nothing", armed or not."""
    return Result.ACCEPTED if command.integer(1) == 0 else Result.DENIED


def _mode(mode: Mode) -> services.Action:
    """Return the action of a command that requests one mode."""
    return lambda _, context: context.port.set_mode(mode, commanded=True)


_REQUEST_CAPABILITIES: int = codec.dialect.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES
_REQUEST_PROTOCOL: int = codec.dialect.MAV_CMD_REQUEST_PROTOCOL_VERSION

ACTIONS: dict[int, services.Action] = {
    codec.dialect.MAV_CMD_COMPONENT_ARM_DISARM: _arm_disarm,
    codec.dialect.MAV_CMD_NAV_TAKEOFF: _takeoff,
    codec.dialect.MAV_CMD_NAV_LAND: _mode(Mode.LAND),
    codec.dialect.MAV_CMD_NAV_LAND_LOCAL: _mode(Mode.PRECISION_LAND),
    codec.dialect.MAV_CMD_NAV_RETURN_TO_LAUNCH: _mode(Mode.RETURN),
    codec.dialect.MAV_CMD_DO_SET_MODE: _set_mode,
    codec.dialect.MAV_CMD_DO_SET_STANDARD_MODE: _set_standard_mode,
    codec.dialect.MAV_CMD_DO_FLIGHTTERMINATION: _terminate,
    codec.dialect.MAV_CMD_RUN_PREARM_CHECKS: _run_checks,
    codec.dialect.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN: _reboot,
    codec.dialect.MAV_CMD_DO_REPOSITION: _reposition,
    codec.dialect.MAV_CMD_DO_CHANGE_ALTITUDE: _change_altitude,
    codec.dialect.MAV_CMD_DO_CHANGE_SPEED: _change_speed,
    codec.dialect.MAV_CMD_DO_ORBIT: _orbit,
    codec.dialect.MAV_CMD_DO_SET_HOME: _set_home,
}
"""Actions by command. Commands without an action in any service are UNSUPPORTED."""


def handle_command_long(message: codec.WireMessage, context: services.Context) -> bool:
    """Execute and acknowledge a COMMAND_LONG."""
    return _handle(
        services.VehicleCommand(message.command, _PARAMS(message), services.sender(message)),
        context,
    )


def handle_command_int(message: codec.WireMessage, context: services.Context) -> bool:
    """Execute and acknowledge a COMMAND_INT."""
    # COMMAND_INT has five floats and a position in 1e-7 degrees.
    four = (message.param1, message.param2, message.param3, message.param4)
    given = (message.x, message.y) != (INT32_MAX, INT32_MAX)  # INT32_MAX = unset
    place = (message.x / 1e7, message.y / 1e7) if given else (math.nan, math.nan)
    params = (*four, *place, message.z)
    return _handle(
        services.VehicleCommand(message.command, params, services.sender(message), message.frame),
        context,
    )


def handle_set_mode(message: codec.WireMessage, context: services.Context) -> bool:
    """Execute a SET_MODE, the legacy message without acknowledgement."""
    if message.target_system != context.system_id:
        return False
    # PX4's custom_mode holds the main mode in byte 2 and the sub mode in byte 3.
    main, sub = message.custom_mode >> 16 & 0xFF, message.custom_mode >> 24 & 0xFF
    _change_mode(message.base_mode, main, sub, context)
    return True


def execute(command: services.VehicleCommand, context: services.Context) -> Result | None:
    """Log and execute a command; None means no COMMAND_ACK: PX4 leaves some unanswered."""
    fields = *command.params, command.number, context.system_id, codec.COMPONENT_ID
    confirmation, from_external = 0, True
    values = *fields, *command.sender, confirmation, from_external
    context.port.logs.command(values, context.now_us)
    action = services.table("ACTIONS").get(command.number)
    if command.number in context.port.parameters.release.unknown_commands:
        action = None
    return Result.UNSUPPORTED if action is None else action(command, context)


def _handle(command: services.VehicleCommand, context: services.Context) -> bool:
    result = execute(command, context)
    if result is not None:
        context.link.send(
            codec.dialect.MAVLink_command_ack_message(command.number, result, 0, 0, *command.sender)
        )
    return True


def is_addressed(message: codec.WireMessage, context: services.Context) -> bool:
    """Return True if a command is for this vehicle. Identity requests may be broadcasts."""
    if message.command in (_REQUEST_CAPABILITIES, _REQUEST_PROTOCOL):
        return message.target_system in (context.system_id, services.ANY)
    return services.for_vehicle(message, context)


_CRITICAL = Severity.CRITICAL
_UNSUPPORTED = OperatorText.of(_CRITICAL, events.AUTO_MODE_UNSUPPORTED)


def _unavailable(name: str, mode: NavigationMode, main: int, sub: int) -> OperatorText:
    """Return PX4's rejection of a known but unavailable mode."""
    number = sub << 24 | main << 16
    text = f"Switching to {name} is currently not available"
    return OperatorText.of(_CRITICAL, events.MODE_NOT_AVAILABLE, number, mode, text=text)


# Modes by main and sub mode. Texts stand for modes that a real PX4 knows by name but never makes
# available; a mode of the table replaces them.
_REQUESTABLE: dict[tuple[int, int], Mode | OperatorText] = {
    (MAIN_AUTO, 0): Mode.MISSION,
    (MAIN_POSCTL, 2): _unavailable("Position Slow", NavigationMode.POSITION_SLOW, MAIN_POSCTL, 2),
    # External modes exist in PX4 only after a ROS 2 node registers them.
    **{
        (MAIN_AUTO, 10 + n): _unavailable(
            f"External {n}", NavigationMode(15 + n), MAIN_AUTO, 10 + n
        )
        for n in range(1, 9)
    },
    **{(mode.spec.main, mode.spec.sub): mode for mode in Mode if mode.spec.requestable},
}


def requested_mode(base: int, main: int, sub: int) -> Mode | OperatorText | None:
    """Return the mode requested by DO_SET_MODE, given parameters 1 to 3.

    The parameters are MAV_MODE_FLAG bits, main mode and sub mode. A message is PX4's explanation of
    an unavailable mode. None: PX4 accepts the request without effect (unknown main mode).
    """
    if not base & codec.dialect.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED:
        # Clients without custom modes describe the mode by bits.
        return _from_base_mode(base)
    # PX4 treats an unknown sub mode of POSCTL as Position.
    other = _UNSUPPORTED if main == MAIN_AUTO else _REQUESTABLE.get((main, 0))
    return _REQUESTABLE.get((main, sub), other)


def _from_base_mode(base: int) -> Mode | None:
    """Return the mode that PX4 derives from the bits of clients without custom modes."""
    if base & codec.dialect.MAV_MODE_FLAG_AUTO_ENABLED:
        return Mode.MISSION
    if not base & codec.dialect.MAV_MODE_FLAG_MANUAL_INPUT_ENABLED:
        return None
    if base & codec.dialect.MAV_MODE_FLAG_GUIDED_ENABLED:
        return Mode.POSITION
    return Mode.STABILIZED if base & codec.dialect.MAV_MODE_FLAG_STABILIZE_ENABLED else Mode.MANUAL


HANDLERS: services.Handlers = {
    "COMMAND_LONG": (is_addressed, handle_command_long),
    "COMMAND_INT": (is_addressed, handle_command_int),
    "SET_MODE": (services.for_anyone, handle_set_mode),
    "SET_GPS_GLOBAL_ORIGIN": (services.for_anyone, handle_set_origin),
}
