"""Pilot's sticks (MANUAL_CONTROL, RC_CHANNELS_OVERRIDE), and the target of Follow Me.

Source: PX4 1.16, MavlinkReceiver::handle_message_manual_control, _rc_channels_override and
_follow_target.
"""

from __future__ import annotations

import math

from airl_mav.core.frames import Geodetic, geodetic_to_local
from firmware_sim.autopilot.inputs import FollowedTarget, Source, Sticks
from firmware_sim.mavlink.codec import WireMessage
from firmware_sim.mavlink.services.context import Context

_CENTRE_US, _HALF_US = 1500.0, 500.0
"""Pulse width of a channel's centre, and from there to the maximum [µs]."""

_NO_CHANNEL = (0, 65_535)
"""Pulse widths that mean no channel."""

_HAS_VELOCITY = 1 << 1
"""Velocity bit of FOLLOW_TARGET.est_capabilities."""


def is_for_pilot(message: WireMessage, context: Context) -> bool:
    """Return True if a MANUAL_CONTROL is addressed to this vehicle."""
    return bool(message.target in (0, context.system_id))


def is_for_radio(message: WireMessage, context: Context) -> bool:
    """Return True if an RC_CHANNELS_OVERRIDE is addressed to this vehicle."""
    return bool(message.target_system in (0, context.system_id))


def handle_manual_control(message: WireMessage, context: Context) -> bool:
    """Handle MANUAL_CONTROL: throttle 0..1000, others -1000..1000; 0 if out of range."""
    sticks = Sticks(
        roll=_share(message.y),
        pitch=_share(message.x),
        # 0..1000 becomes -1..1: PX4's throttle stick is centred at 500.
        throttle=2.0 * message.z / 1000.0 - 1.0 if 0 <= message.z <= 1000 else 0.0,
        yaw=_share(message.r),
    )
    context.port.manual_control(sticks, Source.JOYSTICK, context.now_us)
    return True


def handle_channels(message: WireMessage, context: Context) -> bool:
    """Handle RC_CHANNELS_OVERRIDE: roll, pitch, throttle, yaw in channels 1 to 4 (usual order).

    Pulling the pitch stick increases its pulse width. All four channels are required.
    """
    context.radio.hear(message, context.now_us)
    raw = (message.chan1_raw, message.chan2_raw, message.chan3_raw, message.chan4_raw)
    if any(width in _NO_CHANNEL for width in raw):
        return False
    roll, pitch, throttle, yaw = (
        min(1.0, max(-1.0, (width - _CENTRE_US) / _HALF_US)) for width in raw
    )
    # A pulled pitch stick raises the nose, so the pulse width has the opposite sign.
    context.port.manual_control(Sticks(roll, -pitch, throttle, yaw), Source.RADIO, context.now_us)
    return True


def handle_follow_target(message: WireMessage, context: Context) -> bool:
    """Handle FOLLOW_TARGET: position, and velocity if available."""
    origin = context.port.state().origin
    # PX4 treats latitude and longitude 0 as no position.
    if origin is None or (message.lat, message.lon) == (0, 0):
        return False
    place = Geodetic(message.lat / 1e7, message.lon / 1e7, message.alt)
    north, east, down = geodetic_to_local(place, origin).tolist()
    vn, ve, vd = message.vel if message.est_capabilities & _HAS_VELOCITY else (0.0, 0.0, 0.0)
    if not all(map(math.isfinite, (north, east, down, vn, ve, vd))):
        return False
    target = FollowedTarget((north, east, down), (vn, ve, vd), context.now_us)
    context.port.follow(target)
    return True


def _share(raw: int) -> float:
    return raw / 1000.0 if -1000 <= raw <= 1000 else 0.0
