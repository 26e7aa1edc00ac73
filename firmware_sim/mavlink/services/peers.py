"""Other systems: HEARTBEAT, PING, TIMESYNC, SETUP_SIGNING, and streams for them to answer."""

from __future__ import annotations

from itertools import count

from airl_mav.core.clock import NS_PER_US
from firmware_sim.autopilot.autopilot_state import Arming, Message, Severity
from firmware_sim.mavlink.codec import WireMessage, dialect
from firmware_sim.mavlink.services.context import ANY, Context, sender
from firmware_sim.mavlink.streams import Builder


def handle_heartbeat(message: WireMessage, context: Context) -> bool:
    """Notify the autopilot of a ground station's heartbeat (PX4's data link loss), of no other."""
    if message.type == dialect.MAV_TYPE_GCS:
        context.port.gcs_heartbeat(context.now_us)
    return True


def handle_ping(message: WireMessage, context: Context) -> bool:
    """Return a request (target 0/0) to its sender; an answer to our own request ends here."""
    if (message.target_system, message.target_component) != (ANY, ANY):
        return False
    context.link.send(
        dialect.MAVLink_ping_message(message.time_usec, message.seq, *sender(message))
    )
    return True


def handle_timesync(message: WireMessage, context: Context) -> bool:
    """Answer a request (tc1 = 0) with our time [ns]. An answer to ours needs no action.

    It lets peers measure the offset to the vehicle's clock (simulated time since boot).
    """
    if message.tc1 != 0:
        return False
    context.link.send(dialect.MAVLink_timesync_message(context.now_us * NS_PER_US, message.ts1))
    return True


def ping_requests() -> Builder:
    """Return the builder of one link's PING stream, which counts its requests."""
    sequence = count()
    return lambda state: (state.time_us, next(sequence) & 0xFFFF_FFFF, ANY, ANY)


def handle_setup(message: WireMessage, context: Context) -> bool:
    """SETUP_SIGNING: take another key for frames from now on, or none if it is all zeros.

    As PX4 has it (PR 25284): unsigned it is taken only while there is no key, and never while
    armed.
    """
    if context.port.state().status.arming is Arming.ARMED:
        return False
    key = bytes(message.secret_key)
    try:
        context.signing.change(key if any(key) else None, message.initial_timestamp)
    except OSError as error:
        text = f"Signing key not stored: {error.strerror}"
        context.announce(Message(Severity.CRITICAL, text))
    else:
        what = "set" if any(key) else "removed"
        system, component = sender(message)
        text = f"Signing key {what} by system {system} component {component}"
        context.announce(Message(Severity.NOTICE, text))
    return True
