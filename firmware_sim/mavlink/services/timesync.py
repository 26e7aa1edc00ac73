"""TIMESYNC: lets peers measure the offset to the vehicle's clock (simulated time since boot)."""

from __future__ import annotations

from airl_mav.core.clock import NS_PER_US
from firmware_sim.autopilot.autopilot_state import AutopilotState
from firmware_sim.mavlink.codec import Values, WireMessage, dialect
from firmware_sim.mavlink.services.context import Context, Handler


def handle_timesync(message: WireMessage, context: Context) -> bool:
    """Answer a request (tc1 = 0) with our time [ns]; an answer to ours needs no action."""
    if message.tc1 != 0:
        return False
    context.link.send(dialect.MAVLink_timesync_message(context.now_us * NS_PER_US, message.ts1))
    return True


HANDLERS: dict[str, Handler] = {"TIMESYNC": handle_timesync}


def request(state: AutopilotState) -> Values:
    """Return our own request, a stream on the onboard link."""
    tc1 = 0
    return tc1, state.time_us * NS_PER_US
