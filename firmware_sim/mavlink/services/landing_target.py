"""LANDING_TARGET: where the target of a precision landing is.

As PX4, it takes a position in local NED alone. Bearings of a target need a module that PX4's SITL
does not start, and have no effect here either.
"""

from __future__ import annotations

import math

from firmware_sim.autopilot.autopilot_state import Message, Severity
from firmware_sim.autopilot.events import command_events as events
from firmware_sim.autopilot.requests import LandingTarget
from firmware_sim.mavlink.codec import WireMessage, dialect
from firmware_sim.mavlink.services.context import Context

_LOCAL_NED: int = dialect.MAV_FRAME_LOCAL_NED


def handle(message: WireMessage, context: Context) -> bool:
    """Hand the position over; a frame that PX4 does not take is refused with its text, once."""
    if not message.position_valid:
        return False
    if message.frame != _LOCAL_NED:
        text = f"Landing target: coordinate frame {message.frame} unsupported"
        if text not in context.refusals:
            context.refusals.add(text)
            event = events.LANDING_TARGET_FRAME
            context.announce(Message.of(Severity.CRITICAL, event, message.frame, text=text))
        return False
    position = message.x, message.y, message.z
    if not all(map(math.isfinite, position)):
        return False
    context.port.landing_target(LandingTarget(position, context.now_us))
    return True
