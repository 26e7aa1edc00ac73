"""REQUEST_EVENT: events that a client has missed are sent to it again."""

from __future__ import annotations

from firmware_sim.mavlink.codec import WireMessage, dialect
from firmware_sim.mavlink.event_buffer import KEPT, NUMBERS, message
from firmware_sim.mavlink.services.context import Context


def handle_request(request: WireMessage, context: Context) -> bool:
    """Send events again (REQUEST_EVENT); RESPONSE_EVENT_ERROR for each that is gone."""
    first, last = request.first_sequence, request.last_sequence
    # The first one that is gone tells where to go on: naming thousands would help nobody.
    wanted = min((last - first) % NUMBERS + 1, KEPT)
    for number in range(first, first + wanted):
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
