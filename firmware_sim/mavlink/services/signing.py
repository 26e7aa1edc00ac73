"""SETUP_SIGNING: the key by which frames are signed from now on.

As PX4 has it (PR 25284): unsigned it is taken only while there is no key, and never while armed; a
key of zeros ends the signing.
"""

from __future__ import annotations

from firmware_sim.autopilot.autopilot_state import Arming, Message, Severity
from firmware_sim.mavlink.codec import WireMessage
from firmware_sim.mavlink.services.context import Context, sender


def handle_setup(message: WireMessage, context: Context) -> bool:
    """Take another key, or none."""
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
