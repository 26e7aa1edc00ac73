"""The mission protocol of a vehicle without missions: the list is always empty.

That lets a ground station finish connecting. The same holds for fence and rally points.
"""

from __future__ import annotations

from firmware_sim.mavlink.codec import COMPONENT_ID, SYSTEM_ID, WireMessage, dialect
from firmware_sim.mavlink.services.context import ANY, Context, Handler, sender

_COMPONENTS = (COMPONENT_ID, ANY, dialect.MAV_COMP_ID_MISSIONPLANNER)


def _for_planner(message: WireMessage) -> bool:
    return bool(message.target_system == SYSTEM_ID and message.target_component in _COMPONENTS)


def _acknowledge(message: WireMessage, context: Context, result: int) -> bool:
    if not _for_planner(message):
        return False
    context.link.send(
        dialect.MAVLink_mission_ack_message(*sender(message), result, message.mission_type)
    )
    return True


def handle_download(message: WireMessage, context: Context) -> bool:
    """MISSION_REQUEST_LIST: there are 0 items."""
    if not _for_planner(message):
        return False
    context.link.send(
        dialect.MAVLink_mission_count_message(*sender(message), 0, message.mission_type)
    )
    return True


def handle_item_request(message: WireMessage, context: Context) -> bool:
    """MISSION_REQUEST and MISSION_REQUEST_INT: no sequence number is valid."""
    return _acknowledge(message, context, dialect.MAV_MISSION_INVALID_SEQUENCE)


def handle_upload(message: WireMessage, context: Context) -> bool:
    """MISSION_COUNT: an empty upload is what we have, any other is refused."""
    accepted = message.count == 0
    return _acknowledge(
        message,
        context,
        dialect.MAV_MISSION_ACCEPTED if accepted else dialect.MAV_MISSION_UNSUPPORTED,
    )


def handle_partial_upload(message: WireMessage, context: Context) -> bool:
    """MISSION_WRITE_PARTIAL_LIST: there is nothing to replace."""
    return _acknowledge(message, context, dialect.MAV_MISSION_UNSUPPORTED)


def handle_clear(message: WireMessage, context: Context) -> bool:
    """MISSION_CLEAR_ALL: nothing left to clear."""
    return _acknowledge(message, context, dialect.MAV_MISSION_ACCEPTED)


HANDLERS: dict[str, Handler] = {
    "MISSION_REQUEST_LIST": handle_download,
    "MISSION_REQUEST": handle_item_request,
    "MISSION_REQUEST_INT": handle_item_request,
    "MISSION_COUNT": handle_upload,
    "MISSION_WRITE_PARTIAL_LIST": handle_partial_upload,
    "MISSION_CLEAR_ALL": handle_clear,
}
