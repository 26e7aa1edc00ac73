"""Messages on request, and how often they are streamed.

REQUEST_MESSAGE, SET_MESSAGE_INTERVAL, GET_MESSAGE_INTERVAL and their older kin, answered as a
running PX4 1.16 answers them: a message that has nothing to say is DENIED, the rate of one that is
no stream FAILED.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping
from dataclasses import replace

from firmware_sim.autopilot.autopilot_state import Result
from firmware_sim.mavlink.codec import dialect, message_name
from firmware_sim.mavlink.scheduler import OFF
from firmware_sim.mavlink.services import component_metadata
from firmware_sim.mavlink.services.command import Action, Command
from firmware_sim.mavlink.services.context import Context
from firmware_sim.mavlink.streams import flight_modes
from firmware_sim.mavlink.streams.units import INT32_MAX, boot_ms

_INTERVAL_UNAVAILABLE = 0
"""PX4 says the same of a stream that is off as of one that there is not."""
_MIB = 1024.0 * 1024.0

FIXED_RATE = frozenset(("HEARTBEAT", "MISSION_CURRENT"))
"""Messages that PX4 sends at rates of its own: no client can change them."""


OF_MISSING_DEVICES = frozenset((370, 371))
"""BATTERY_INFO and FUEL_STATUS, which no definitions here have: PX4 accepts a rate, and as it lacks
the devices, sends nothing. A NaN for an id is accepted likewise."""


def _set_message_interval(command: Command, context: Context) -> Result:
    """Parameter 1: message id; 2: interval [µs], 0 or not given = default, negative = off."""
    number = command.integer(1)
    if number is None or number in OF_MISSING_DEVICES:
        return Result.ACCEPTED
    name = _stream_name(number, context)
    if name is None or name in FIXED_RATE:
        return Result.FAILED
    interval = command.params[1]
    scheduler = context.link.scheduler
    if interval < 0.0:
        interval_us = OFF
    elif interval > 0.0:
        interval_us = max(1, round(min(interval, INT32_MAX)))
    else:
        interval_us = scheduler.default_us(name)
    scheduler.set_interval(name, interval_us, context.now_us)
    return Result.ACCEPTED


def _get_message_interval(command: Command, context: Context) -> Result:
    return _send_interval((command.integer(1) or 0) & 0xFFFF, context)


def _request_message(command: Command, context: Context) -> Result:
    """Parameter 1: message id; 2: what the message takes."""
    number = command.integer(1) or 0
    special = _SPECIAL.get(number)
    if special is not None:
        return special(command, context)
    name = _stream_name(number, context)
    return Result.DENIED if name is None else send_stream(name, context)


def _request_interval(command: Command, context: Context) -> Result:
    asked = command.integer(2)
    return Result.DENIED if asked is None else _send_interval(asked & 0xFFFF, context)


def _request_modes(command: Command, context: Context) -> Result:
    """Parameter 2: the mode's number from 1 on; 0 = all."""
    asked = command.integer(2) or 0
    modes = flight_modes.available_modes()
    if not 0 <= asked <= len(modes):
        return Result.DENIED
    for fields in modes if asked == 0 else modes[asked - 1 : asked]:
        context.link.send(dialect.MAVLink_available_modes_message(*fields))
    return Result.ACCEPTED


def _request_storage(command: Command, context: Context) -> Result:
    """Parameter 2: storage number; 0 = all. There is one, with number 1."""
    number, count, empty = 1, 1, b""
    if command.integer(2) not in (None, 0, number):
        return Result.DENIED
    disk = shutil.disk_usage(context.storage.folder)
    sizes = (size / _MIB for size in (disk.total, disk.used, disk.free))
    no_speed = 0.0
    context.link.send(
        dialect.MAVLink_storage_information_message(
            *(boot_ms(context.now_us), number, count, dialect.STORAGE_STATUS_READY),
            *(*sizes, no_speed, no_speed, dialect.STORAGE_TYPE_UNKNOWN, empty),
        )
    )
    return Result.ACCEPTED


def _first_as_second(command: Command) -> Command:
    first = command.params[0]
    return replace(command, params=(first, first, *command.params[2:]))


_SPECIAL: Mapping[int, Callable[[Command, Context], Result]] = {
    dialect.MAVLINK_MSG_ID_MESSAGE_INTERVAL: _request_interval,
    dialect.MAVLINK_MSG_ID_AVAILABLE_MODES: _request_modes,
    dialect.MAVLINK_MSG_ID_COMPONENT_METADATA: component_metadata.request_metadata,
    dialect.MAVLINK_MSG_ID_COMPONENT_INFORMATION: component_metadata.request_information,
    dialect.MAVLINK_MSG_ID_STORAGE_INFORMATION: _request_storage,
}
"""Messages that are no streams, or whose request has parameters."""


def send_stream(name: str, context: Context) -> Result:
    """Send one of the streamed messages now; DENIED when it has nothing to say.

    UNSUPPORTED for a message that there is not.
    """
    if name not in context.link.builders:
        return Result.UNSUPPORTED
    sent = context.link.send_stream(name, context.port.state())
    return Result.ACCEPTED if sent else Result.DENIED


def _stream_name(number: int | None, context: Context) -> str | None:
    """Return the stream with a message id, None when there is none."""
    name = None if number is None else message_name(number)
    return name if name in context.link.builders else None


def _send_interval(number: int, context: Context) -> Result:
    name, interval = _stream_name(number, context), _INTERVAL_UNAVAILABLE
    if name is not None:
        interval = context.link.scheduler.interval_us(name)
        interval = _INTERVAL_UNAVAILABLE if interval == OFF else interval
    context.link.send(dialect.MAVLink_message_interval_message(number, interval))
    return Result.ACCEPTED


ACTIONS: dict[int, Action] = {
    dialect.MAV_CMD_SET_MESSAGE_INTERVAL: _set_message_interval,
    dialect.MAV_CMD_GET_MESSAGE_INTERVAL: _get_message_interval,
    dialect.MAV_CMD_REQUEST_MESSAGE: _request_message,
    dialect.MAV_CMD_GET_HOME_POSITION: lambda _, context: send_stream("HOME_POSITION", context),
    dialect.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES: (
        lambda _, context: send_stream("AUTOPILOT_VERSION", context)
    ),
    dialect.MAV_CMD_REQUEST_PROTOCOL_VERSION: (
        lambda _, context: send_stream("PROTOCOL_VERSION", context)
    ),
    dialect.MAV_CMD_REQUEST_FLIGHT_INFORMATION: (
        lambda _, context: send_stream("FLIGHT_INFORMATION", context)
    ),
    dialect.MAV_CMD_REQUEST_STORAGE_INFORMATION: (
        lambda command, context: _request_storage(_first_as_second(command), context)
    ),
}
