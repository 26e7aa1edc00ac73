"""PING: periodic requests to all peers, and answers to theirs."""

from __future__ import annotations

from firmware_sim.autopilot.autopilot_state import AutopilotState
from firmware_sim.mavlink.codec import Values, WireMessage, dialect
from firmware_sim.mavlink.services.context import ANY, Context, Handler, sender


def handle_ping(message: WireMessage, context: Context) -> bool:
    """Return a request (target 0/0) to its sender; an answer to our own request ends here."""
    if (message.target_system, message.target_component) != (ANY, ANY):
        return False
    context.link.send(
        dialect.MAVLink_ping_message(message.time_usec, message.seq, *sender(message))
    )
    return True


HANDLERS: dict[str, Handler] = {"PING": handle_ping}


class PingRequests:
    """Builds one link's PING stream."""

    def __init__(self) -> None:
        self._sequence = 0

    def message(self, state: AutopilotState) -> Values:
        """Return the next request."""
        sequence = self._sequence
        self._sequence = (sequence + 1) & 0xFFFF_FFFF
        return state.time_us, sequence, ANY, ANY
