"""COMMAND_LONG, COMMAND_INT and SET_MODE.

Answers and refusals follow PX4's Commander.cpp and mavlink_receiver.cpp, checked against a
running PX4 1.16. Every command addressed to the vehicle is acknowledged to its sender, on the
link it came from; the same command may come twice (clients repeat), so actions are idempotent.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from firmware_sim.autopilot.autopilot_state import Message, Mode, Result, Severity
from firmware_sim.mavlink.codec import WireMessage, dialect, message_id
from firmware_sim.mavlink.px4_custom_mode import requested_mode
from firmware_sim.mavlink.scheduler import OFF
from firmware_sim.mavlink.services.context import (
    ANY,
    Context,
    for_vehicle,
    sender,
)
from firmware_sim.mavlink.streams.units import INT32_MAX

FORCE_MAGIC = 21_196
"""MAV_CMD_COMPONENT_ARM_DISARM param2 that skips the checks."""

_RELATIVE_FRAMES = (
    dialect.MAV_FRAME_GLOBAL_RELATIVE_ALT,
    dialect.MAV_FRAME_GLOBAL_RELATIVE_ALT_INT,
)
_INTERVAL_DISABLED, _INTERVAL_UNAVAILABLE = -1, 0


@dataclass(frozen=True, slots=True)
class Command:
    """A COMMAND_LONG or COMMAND_INT."""

    number: int
    """MAV_CMD."""
    params: tuple[float, float, float, float, float, float, float]
    """Parameters 1..7 of COMMAND_LONG; NaN = not given."""
    frame: int | None = None
    """MAV_FRAME of a COMMAND_INT."""

    def integer(self, number: int) -> int | None:
        """Return parameter 1..7 rounded, None when it is not a finite number."""
        value = self.params[number - 1]
        return round(value) if math.isfinite(value) else None


Action = Callable[[Command, Context], Result]


def _arm_disarm(command: Command, context: Context) -> Result:
    force = command.integer(2) == FORCE_MAGIC
    if command.integer(1) == 1:
        return context.port.arm(force=force)
    if command.integer(1) == 0:
        return context.port.disarm(force=force)
    text = f"Unsupported ARM_DISARM param: {command.params[0]:.3f}"
    context.announce(Message(Severity.CRITICAL, text))
    return Result.UNSUPPORTED


def _takeoff(command: Command, context: Context) -> Result:
    """Parameter 7: altitude above mean sea level [m], above home in a relative frame."""
    altitude = command.params[6]
    if not math.isfinite(altitude):
        return context.port.takeoff(None)
    if command.frame in _RELATIVE_FRAMES:
        return context.port.takeoff(altitude)
    home = context.port.state().home
    if home is None:
        return Result.TEMPORARILY_REJECTED
    return context.port.takeoff(altitude - home.altitude_m)


def _set_mode(command: Command, context: Context) -> Result:
    base, main, sub = (command.integer(number) or 0 for number in (1, 2, 3))
    return _change_mode(base, main, sub, context)


def _change_mode(base: int, main: int, sub: int, context: Context) -> Result:
    request = requested_mode(base, main, sub)
    if isinstance(request, str):
        context.announce(Message(Severity.CRITICAL, request))
        return Result.TEMPORARILY_REJECTED
    return Result.ACCEPTED if request is None else context.port.set_mode(request)


def _set_home(command: Command, context: Context) -> Result:
    if command.integer(1) == 1:
        return context.port.set_home_here()
    return Result.DENIED  # another place than the present one


def _reboot(command: Command, _context: Context) -> Result:
    """PX4 SITL has no board to reset: doing nothing is all it accepts, armed or not."""
    return Result.ACCEPTED if command.integer(1) == 0 else Result.DENIED


def _set_message_interval(command: Command, context: Context) -> Result:
    """Parameter 1: message id; 2: interval [µs], 0 = default, negative = off."""
    name = _stream_name(command.integer(1), context)
    interval = command.params[1]
    if name is None:
        return Result.UNSUPPORTED
    if not math.isfinite(interval):
        return Result.DENIED
    scheduler = context.link.scheduler
    if interval < 0.0:
        interval_us = OFF
    elif interval == 0.0:
        interval_us = scheduler.default_us(name)
    else:
        interval_us = min(max(1, round(interval)), INT32_MAX)
    scheduler.set_interval(name, interval_us, context.now_us)
    return Result.ACCEPTED


def _get_message_interval(command: Command, context: Context) -> Result:
    number = command.integer(1)
    if number is None or not 0 <= number <= 0xFFFF:
        return Result.DENIED
    return _send_interval(number, context)


def _request_message(command: Command, context: Context) -> Result:
    """Parameter 1: message id. Known but nothing to say yet: DENIED, as PX4."""
    name = _stream_name(command.integer(1), context)
    if name is not None:
        return _send_stream(name, context)
    if command.integer(1) == dialect.MAVLINK_MSG_ID_MESSAGE_INTERVAL:
        asked = command.integer(2)
        return Result.DENIED if asked is None else _send_interval(asked & 0xFFFF, context)
    return Result.UNSUPPORTED


def _send_stream(name: str, context: Context) -> Result:
    sent = context.link.send_stream(name, context.port.state())
    return Result.ACCEPTED if sent else Result.DENIED


_REQUEST_CAPABILITIES: int = dialect.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES
_REQUEST_PROTOCOL: int = dialect.MAV_CMD_REQUEST_PROTOCOL_VERSION

ACTIONS: dict[int, Action] = {
    dialect.MAV_CMD_COMPONENT_ARM_DISARM: _arm_disarm,
    dialect.MAV_CMD_NAV_TAKEOFF: _takeoff,
    dialect.MAV_CMD_NAV_LAND: lambda _, context: context.port.set_mode(Mode.LAND),
    dialect.MAV_CMD_NAV_RETURN_TO_LAUNCH: lambda _, context: context.port.set_mode(Mode.RETURN),
    dialect.MAV_CMD_DO_SET_MODE: _set_mode,
    dialect.MAV_CMD_DO_SET_HOME: _set_home,
    dialect.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN: _reboot,
    dialect.MAV_CMD_SET_MESSAGE_INTERVAL: _set_message_interval,
    dialect.MAV_CMD_GET_MESSAGE_INTERVAL: _get_message_interval,
    dialect.MAV_CMD_REQUEST_MESSAGE: _request_message,
    dialect.MAV_CMD_GET_HOME_POSITION: lambda _, context: _send_stream("HOME_POSITION", context),
    _REQUEST_CAPABILITIES: lambda _, context: _send_stream("AUTOPILOT_VERSION", context),
}
"""Everything else is UNSUPPORTED, MAV_CMD_REQUEST_PROTOCOL_VERSION too: its answer is not in
pymavlink's dialect, and clients then go by the MAVLink 2 frames they see."""


def handle_command_long(message: WireMessage, context: Context) -> bool:
    """Carry out and acknowledge a COMMAND_LONG."""
    params = tuple(getattr(message, f"param{number}") for number in range(1, 8))
    return _handle(message, Command(message.command, params), context)


def handle_command_int(message: WireMessage, context: Context) -> bool:
    """Carry out and acknowledge a COMMAND_INT."""
    four = (message.param1, message.param2, message.param3, message.param4)
    params = (*four, message.x / 1e7, message.y / 1e7, message.z)
    return _handle(message, Command(message.command, params, message.frame), context)


def handle_set_mode(message: WireMessage, context: Context) -> bool:
    """Carry out a SET_MODE, the old message without acknowledgement."""
    if message.target_system != context.system_id:
        return False
    main, sub = message.custom_mode >> 16 & 0xFF, message.custom_mode >> 24 & 0xFF
    _change_mode(message.base_mode, main, sub, context)
    return True


def _handle(message: WireMessage, command: Command, context: Context) -> bool:
    action = ACTIONS.get(command.number)
    result = Result.UNSUPPORTED if action is None else action(command, context)
    context.link.send(
        dialect.MAVLink_command_ack_message(command.number, result, 0, 0, *sender(message))
    )
    return True


def is_addressed(message: WireMessage, context: Context) -> bool:
    """Return whether a command is for this vehicle: who it is may be asked of all systems."""
    if message.command in (_REQUEST_CAPABILITIES, _REQUEST_PROTOCOL):
        return message.target_system in (context.system_id, ANY)
    return for_vehicle(message, context)


def _stream_name(number: int | None, context: Context) -> str | None:
    """Return the stream with a message id, None when there is none."""
    return next((name for name in context.link.builders if message_id(name) == number), None)


def _send_interval(number: int, context: Context) -> Result:
    name, interval = _stream_name(number, context), _INTERVAL_UNAVAILABLE
    if name is not None:
        interval = context.link.scheduler.interval_us(name)
        interval = _INTERVAL_DISABLED if interval == OFF else interval
    context.link.send(dialect.MAVLink_message_interval_message(number, interval))
    return Result.ACCEPTED
