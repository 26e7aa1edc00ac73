"""Stream rates, message requests, HEARTBEAT, PING, TIMESYNC and SETUP_SIGNING.

REQUEST_MESSAGE, SET_MESSAGE_INTERVAL, GET_MESSAGE_INTERVAL and older equivalents, with the replies
of a running PX4 1.16. A request for a message without content is DENIED; setting the rate of a
message that is not a stream is FAILED.
"""

from __future__ import annotations

from itertools import count

from airl_mav.core.clock import NS_PER_US
from firmware_sim.autopilot.autopilot_state import Arming, OperatorText, Result, Severity
from firmware_sim.mavlink import message_rates, services
from firmware_sim.mavlink.codec import WireMessage, dialect, message_name
from firmware_sim.mavlink.streams import Builder, units
from firmware_sim.mavlink.texts_and_events import KEPT, NUMBERS, message

_INTERVAL_UNAVAILABLE = 0
"""Reported interval of a stream that is off. PX4 reports the same for an unknown stream."""

FIXED_RATE = frozenset(("HEARTBEAT", "MISSION_CURRENT"))
"""Messages with fixed rates in PX4, which clients cannot change."""

OF_MISSING_DEVICES = frozenset((370, 371))
"""Ids of BATTERY_INFO and FUEL_STATUS, which the definitions here lack. PX4 accepts a rate but
sends nothing, because it lacks the devices. PX4 also accepts a NaN id."""


def _set_message_interval(command: services.VehicleCommand, context: services.Context) -> Result:
    """Handle parameter 1: message id; 2: interval [µs], 0 or unset = default, negative = off."""
    number = command.integer(1)
    # PX4 accepts the rate of a missing device without effect.
    if number is None or number in OF_MISSING_DEVICES:
        return Result.ACCEPTED
    name = _stream_name(number, context)
    if name is None or name in FIXED_RATE:
        return Result.FAILED
    interval = command.params[1]
    scheduler = context.link.scheduler
    if interval < 0.0:
        # MAVLink: -1 disables the message, 0 restores the default rate.
        interval_us = message_rates.OFF
    elif interval > 0.0:
        # The upper limit keeps the value in the reply's int32 field; 1 µs is sent every tick.
        interval_us = max(1, round(min(interval, units.INT32_MAX)))
    else:
        interval_us = scheduler.default_us(name)
    scheduler.set_interval(name, interval_us, context.now_us)
    return Result.ACCEPTED


def _get_message_interval(command: services.VehicleCommand, context: services.Context) -> Result:
    return _send_interval((command.integer(1) or 0) & 0xFFFF, context)


def _request_message(command: services.VehicleCommand, context: services.Context) -> Result:
    """Handle parameter 1: message id; 2: parameter of the message."""
    number = command.integer(1) or 0
    # Some messages take a parameter or are not streams.
    special = services.table("REQUESTS").get(number)
    if special is not None:
        result: Result = special(command, context)
        return result
    name = _stream_name(number, context)
    return Result.DENIED if name is None else send_stream(name, context)


def _request_interval(command: services.VehicleCommand, context: services.Context) -> Result:
    number = command.integer(2)
    return Result.DENIED if number is None else _send_interval(number & 0xFFFF, context)


REQUESTS: dict[int, services.Action] = {
    dialect.MAVLINK_MSG_ID_MESSAGE_INTERVAL: _request_interval,
}
"""Messages that are not streams, or whose request has parameters."""


def send_stream(name: str, context: services.Context) -> Result:
    """Send a streamed message now; DENIED = no content, UNSUPPORTED = unknown message."""
    if name not in context.link.builders:
        return Result.UNSUPPORTED
    sent = context.link.send_stream(name, context.port.state())
    return Result.ACCEPTED if sent else Result.DENIED


def _stream_name(number: int | None, context: services.Context) -> str | None:
    """Return the name of the stream with a message id; None if unknown."""
    name = None if number is None else message_name(number)
    return name if name in context.link.builders else None


def _send_interval(number: int, context: services.Context) -> Result:
    name, interval = _stream_name(number, context), _INTERVAL_UNAVAILABLE
    if name is not None:
        interval = context.link.scheduler.interval_us(name)
        interval = _INTERVAL_UNAVAILABLE if interval == message_rates.OFF else interval
    context.link.send(dialect.MAVLink_message_interval_message(number, interval))
    return Result.ACCEPTED


def handle_event(request: WireMessage, context: services.Context) -> bool:
    """Handle REQUEST_EVENT: resend events, or RESPONSE_EVENT_ERROR for each expired event."""
    first, last = request.first_sequence, request.last_sequence
    # Limited: the first error reply already contains the oldest available number.
    events_requested = min((last - first) % NUMBERS + 1, KEPT)
    for number in range(first, first + events_requested):
        # Sequence numbers wrap around at 65536.
        sequence = number % NUMBERS
        sent = context.events.get(sequence)
        if sent is not None:
            context.link.send(message(sent))
            continue
        context.link.send(
            dialect.MAVLink_response_event_error_message(
                *(request.get_srcSystem(), request.get_srcComponent(), sequence),
                *(context.events.after(sequence), dialect.MAV_EVENT_ERROR_REASON_UNAVAILABLE),
            )
        )
    return True


def _sends(name: str) -> services.Action:
    """Return the action that sends a stream's message."""
    return lambda _, context: send_stream(name, context)


ACTIONS: dict[int, services.Action] = {
    dialect.MAV_CMD_SET_MESSAGE_INTERVAL: _set_message_interval,
    dialect.MAV_CMD_GET_MESSAGE_INTERVAL: _get_message_interval,
    dialect.MAV_CMD_REQUEST_MESSAGE: _request_message,
    dialect.MAV_CMD_GET_HOME_POSITION: _sends("HOME_POSITION"),
    dialect.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES: _sends("AUTOPILOT_VERSION"),
    dialect.MAV_CMD_REQUEST_PROTOCOL_VERSION: _sends("PROTOCOL_VERSION"),
    dialect.MAV_CMD_REQUEST_FLIGHT_INFORMATION: _sends("FLIGHT_INFORMATION"),
}


def handle_heartbeat(message: WireMessage, context: services.Context) -> bool:
    """Report a ground station's heartbeat to the autopilot (PX4's data link loss), and no other."""
    if message.type == dialect.MAV_TYPE_GCS:
        context.port.gcs_heartbeat(context.now_us)
    return True


def handle_ping(message: WireMessage, context: services.Context) -> bool:
    """Return a request (target 0/0) to its sender. Replies to our requests need no action."""
    # Other targets are replies, or requests to another system.
    if (message.target_system, message.target_component) != (services.ANY, services.ANY):
        return False
    context.link.send(
        dialect.MAVLink_ping_message(message.time_usec, message.seq, *services.sender(message))
    )
    return True


def handle_timesync(message: WireMessage, context: services.Context) -> bool:
    """Answer a request (tc1 = 0) with the vehicle's time [ns]. Replies need no action.

    Peers can measure the offset to the vehicle's clock (simulated time since boot).
    """
    if message.tc1 != 0:
        return False
    context.link.send(dialect.MAVLink_timesync_message(context.now_us * NS_PER_US, message.ts1))
    return True


def ping_requests() -> Builder:
    """Return the builder of one link's PING stream, with numbered requests."""
    sequence = count()
    return lambda state: (state.time_us, next(sequence) & 0xFFFF_FFFF, services.ANY, services.ANY)


def handle_setup(message: WireMessage, context: services.Context) -> bool:
    """Handle SETUP_SIGNING: replace the signing key; all zeros remove it.

    As in PX4 (PR 25284), an unsigned message is accepted only without a key, and never while armed.
    """
    if context.port.state().status.arming is Arming.ARMED:
        return False
    key = bytes(message.secret_key)
    try:
        context.signing.change(key if any(key) else None, message.initial_timestamp)
    except OSError as error:
        text = f"Signing key not stored: {error.strerror}"
        context.announce(OperatorText(Severity.CRITICAL, text))
    else:
        # Other operators must notice a change of the key.
        what = "set" if any(key) else "removed"
        system, component = services.sender(message)
        text = f"Signing key {what} by system {system} component {component}"
        context.announce(OperatorText(Severity.NOTICE, text))
    return True


HANDLERS: services.Handlers = {
    "REQUEST_EVENT": (services.for_vehicle, handle_event),
    "HEARTBEAT": (services.for_anyone, handle_heartbeat),
    "SETUP_SIGNING": (services.for_vehicle_or_all, handle_setup),
    "PING": (services.for_anyone, handle_ping),
    "TIMESYNC": (services.for_anyone, handle_timesync),
}
