"""HEARTBEAT of other systems: only a ground station's matters (PX4's data link loss)."""

from __future__ import annotations

from firmware_sim.mavlink.codec import WireMessage, dialect
from firmware_sim.mavlink.services.context import Context, Handler


def handle_heartbeat(message: WireMessage, context: Context) -> bool:
    """Notify the autopilot of a ground station's heartbeat."""
    if message.type == dialect.MAV_TYPE_GCS:
        context.port.gcs_heartbeat(context.now_us)
    return True


HANDLERS: dict[str, Handler] = {"HEARTBEAT": handle_heartbeat}
