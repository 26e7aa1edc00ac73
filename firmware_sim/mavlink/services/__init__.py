"""MAVLink microservices: a table of message names with their addressee check and handler."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cache
from types import MappingProxyType
from typing import Any

from airl_mav.core.addons import entries, load
from firmware_sim.autopilot.autopilot_state import OperatorText, Severity
from firmware_sim.mavlink.codec import WireMessage
from firmware_sim.mavlink.services import (
    calibration,
    commands,
    connection,
    ftp,
    logs,
    measurements,
    params,
    setpoints,
    shell,
)
from firmware_sim.mavlink.services.context import Context, for_vehicle, for_vehicle_or_all

Handler = Callable[[WireMessage, Context], bool]
"""Handles one message for this vehicle; returns False if it had no effect."""


def _for_anyone(_message: WireMessage, _context: Context) -> bool:
    return True


Addressee = Callable[[WireMessage, Context], bool]
"""Returns True if a message is addressed to this vehicle."""

HANDLERS: Mapping[str, tuple[Addressee, Handler]] = MappingProxyType(
    {
        "COMMAND_LONG": (commands.is_addressed, commands.handle_command_long),
        "COMMAND_INT": (commands.is_addressed, commands.handle_command_int),
        "SET_MODE": (_for_anyone, commands.handle_set_mode),
        "REQUEST_DATA_STREAM": (for_vehicle_or_all, connection.handle_data_stream),
        "PARAM_REQUEST_LIST": (for_vehicle, params.handle_list),
        "PARAM_REQUEST_READ": (for_vehicle, params.handle_read),
        "PARAM_SET": (for_vehicle, params.handle_set),
        "SET_POSITION_TARGET_LOCAL_NED": (for_vehicle_or_all, setpoints.handle_local),
        "SET_POSITION_TARGET_GLOBAL_INT": (for_vehicle_or_all, setpoints.handle_global),
        "SET_ATTITUDE_TARGET": (for_vehicle_or_all, setpoints.handle_attitude),
        "MANUAL_CONTROL": (setpoints.is_for_pilot, setpoints.handle_manual_control),
        "RC_CHANNELS_OVERRIDE": (setpoints.is_for_radio, setpoints.handle_channels),
        "FOLLOW_TARGET": (_for_anyone, setpoints.handle_follow_target),
        "LANDING_TARGET": (_for_anyone, measurements.handle_landing_target),
        "DISTANCE_SENSOR": (_for_anyone, measurements.handle_distance),
        "OPTICAL_FLOW_RAD": (_for_anyone, measurements.handle_optical_flow),
        "OBSTACLE_DISTANCE": (_for_anyone, measurements.handle_obstacle_distance),
        "ODOMETRY": (_for_anyone, measurements.handle_odometry),
        "VISION_POSITION_ESTIMATE": (_for_anyone, measurements.handle_vision_position),
        "HEARTBEAT": (_for_anyone, connection.handle_heartbeat),
        "SET_GPS_GLOBAL_ORIGIN": (_for_anyone, commands.handle_set_origin),
        "SETUP_SIGNING": (for_vehicle_or_all, connection.handle_setup),
        "REQUEST_EVENT": (for_vehicle, connection.handle_event),
        "PING": (_for_anyone, connection.handle_ping),
        "TIMESYNC": (_for_anyone, connection.handle_timesync),
        "SERIAL_CONTROL": (_for_anyone, shell.handle_input),
        "FILE_TRANSFER_PROTOCOL": (for_vehicle_or_all, ftp.handle_request),
        "LOG_REQUEST_LIST": (for_vehicle_or_all, logs.handle_list),
        "LOG_REQUEST_DATA": (for_vehicle_or_all, logs.handle_data),
        "LOG_REQUEST_END": (for_vehicle_or_all, logs.handle_end),
        "LOG_ERASE": (for_vehicle_or_all, logs.handle_erase),
        "LOGGING_ACK": (for_vehicle_or_all, logs.handle_ack),
    }
)


@cache
def added() -> tuple[Any, ...]:
    """Return the services of add-ons: modules with HANDLERS and `send_pending`."""
    return tuple(load(place) for place in entries("firmware_sim", "SERVICES").values())


@cache
def handlers() -> Mapping[str, tuple[Addressee, Handler]]:
    """Return all handlers by message: of the core, and of add-ons."""
    found = dict(HANDLERS)
    for service in added():
        found |= service.HANDLERS
    return found


def handle(message: WireMessage, kind: str, context: Context) -> bool:
    """Handle a message of a type; return True if it was for this vehicle and had an effect."""
    is_addressed, handler = handlers().get(kind, (None, None))
    if handler is None and kind in _MISSION_STARTS and message.target_system == context.system_id:
        context.announce_once(OperatorText(Severity.ERROR, "No missions without add-on missions"))
    return bool(
        is_addressed and handler and is_addressed(message, context) and handler(message, context)
    )


_MISSION_STARTS = ("MISSION_REQUEST_LIST", "MISSION_COUNT")
"""First messages of a download and an upload."""


def _send_added(context: Context) -> None:
    for service in added():
        service.send_pending(context)


PENDING: tuple[Callable[[Context], None], ...] = (
    params.send_pending,
    _send_added,
    ftp.send_pending,
    calibration.send_pending,
    shell.send_pending,
    logs.send_pending,
)
"""Functions that send the next part of a client's transfers, once per tick and client."""


def send_pending(context: Context) -> None:
    """Send the next part of all transfers of a client."""
    if not context.is_getting:  # Usual case: only mission progress may be due.
        _send_added(context)
        return
    for send in PENDING:
        send(context)
