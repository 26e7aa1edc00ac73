"""HEARTBEAT, PING, TIMESYNC and SETUP_SIGNING of other systems, and streamed requests."""

from __future__ import annotations

from itertools import count

from airl_mav.core.clock import NS_PER_US
from firmware_sim.autopilot.autopilot_state import Arming, OperatorText, Severity
from firmware_sim.mavlink.codec import WireMessage, dialect
from firmware_sim.mavlink.services.context import ANY, Context, sender
from firmware_sim.mavlink.streams import Builder


def handle_heartbeat(message: WireMessage, context: Context) -> bool:
    """Report a ground station's heartbeat to the autopilot (PX4's data link loss), and no other."""
    if message.type == dialect.MAV_TYPE_GCS:
        context.port.gcs_heartbeat(context.now_us)
    return True


def handle_ping(message: WireMessage, context: Context) -> bool:
    """Return a request (target 0/0) to its sender. Replies to our requests need no action."""
    # Other targets are replies, or requests to another system.
    if (message.target_system, message.target_component) != (ANY, ANY):
        return False
    context.link.send(
        dialect.MAVLink_ping_message(message.time_usec, message.seq, *sender(message))
    )
    return True


def handle_timesync(message: WireMessage, context: Context) -> bool:
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
    return lambda state: (state.time_us, next(sequence) & 0xFFFF_FFFF, ANY, ANY)


def handle_setup(message: WireMessage, context: Context) -> bool:
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
        system, component = sender(message)
        text = f"Signing key {what} by system {system} component {component}"
        context.announce(OperatorText(Severity.NOTICE, text))
    return True
