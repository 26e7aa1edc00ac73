"""OBSTACLE_DISTANCE: how far obstacles are around the vehicle, for collision prevention.

Source: PX4 1.16, MavlinkReceiver::handle_message_obstacle_distance and CollisionPrevention, which
tells an unknown frame only where it is switched on.
"""

from __future__ import annotations

import math

from firmware_sim.autopilot.autopilot_state import Message, Severity
from firmware_sim.autopilot.events import command_events as events
from firmware_sim.autopilot.requests import Obstacles
from firmware_sim.mavlink.codec import WireMessage, dialect
from firmware_sim.mavlink.services.context import Context

_IN_WORLD = (dialect.MAV_FRAME_GLOBAL, dialect.MAV_FRAME_LOCAL_NED)
_IN_BODY = dialect.MAV_FRAME_BODY_FRD


def handle(message: WireMessage, context: Context) -> bool:
    """Hand the distances over."""
    frame = message.frame
    if frame not in _IN_WORLD and frame != _IN_BODY:
        if context.port.parameters.value("CP_DIST") > 0.0:
            _refuse(frame, context)
        return False
    increment = message.increment_f if message.increment_f > 0.0 else float(message.increment)
    if not (0.0 < increment <= 360.0 and math.isfinite(message.angle_offset)):
        return False
    context.port.see_obstacles(
        Obstacles(
            tuple(message.distances),
            increment,
            message.angle_offset,
            message.min_distance,
            message.max_distance,
            in_world=frame in _IN_WORLD,
            time_us=context.now_us,
        )
    )
    return True


def _refuse(frame: int, context: Context) -> None:
    text = f"Obstacle message received in unsupported frame {frame}"
    if text not in context.refusals:
        context.refusals.add(text)
        event = events.OBSTACLE_FRAME
        context.announce(Message.of(Severity.CRITICAL, event, frame, text=text))
