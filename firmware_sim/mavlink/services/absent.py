"""The protocols of what this vehicle lacks, answered so that a ground station finishes connecting.

Missions, fence and rally points: the list is always empty. FILE_TRANSFER_PROTOCOL: there are no
files, and every request is refused; its payload layout: https://mavlink.io/en/services/ftp.html
"""

from __future__ import annotations

import struct

from firmware_sim.mavlink.codec import COMPONENT_ID, SYSTEM_ID, WireMessage, dialect
from firmware_sim.mavlink.services.context import ANY, Context, sender

MISSION_RESULTS: dict[str, int] = {
    # No sequence number is valid.
    "MISSION_REQUEST": dialect.MAV_MISSION_INVALID_SEQUENCE,
    "MISSION_REQUEST_INT": dialect.MAV_MISSION_INVALID_SEQUENCE,
    # An empty upload is what we have: that one is accepted.
    "MISSION_COUNT": dialect.MAV_MISSION_UNSUPPORTED,
    # There is nothing to replace, and nothing left to clear.
    "MISSION_WRITE_PARTIAL_LIST": dialect.MAV_MISSION_UNSUPPORTED,
    "MISSION_CLEAR_ALL": dialect.MAV_MISSION_ACCEPTED,
}
"""MAV_MISSION_RESULT of each message that is answered by MISSION_ACK."""

_PLANNERS = (COMPONENT_ID, ANY, dialect.MAV_COMP_ID_MISSIONPLANNER)

_FTP_HEADER = struct.Struct("<HBBBBBxI")
"""Sequence, session, opcode, size, requested opcode, burst complete, padding, offset."""
_FTP_PAYLOAD_BYTES = 251
_OPCODE_ACK, _OPCODE_NAK = 128, 129
_UNKNOWN_COMMAND = 7


def is_for_planner(message: WireMessage) -> bool:
    """Return whether a message is addressed to this vehicle's missions."""
    return bool(message.target_system == SYSTEM_ID and message.target_component in _PLANNERS)


def handle_download(message: WireMessage, context: Context) -> bool:
    """MISSION_REQUEST_LIST: there are 0 items."""
    context.link.send(
        dialect.MAVLink_mission_count_message(*sender(message), 0, message.mission_type)
    )
    return True


def acknowledge(message: WireMessage, context: Context) -> bool:
    """Answer the messages of `MISSION_RESULTS`."""
    name = message.get_type()
    empty_upload = name == "MISSION_COUNT" and message.count == 0
    result = dialect.MAV_MISSION_ACCEPTED if empty_upload else MISSION_RESULTS[name]
    context.link.send(
        dialect.MAVLink_mission_ack_message(*sender(message), result, message.mission_type)
    )
    return True


def handle_file_transfer(message: WireMessage, context: Context) -> bool:
    """Answer a request with NAK "unknown command"."""
    sequence, session, opcode, *_ = _FTP_HEADER.unpack_from(bytes(message.payload))
    if opcode in (_OPCODE_ACK, _OPCODE_NAK):
        return False
    answer = _FTP_HEADER.pack((sequence + 1) & 0xFFFF, session, _OPCODE_NAK, 1, opcode, 0, 0)
    body = (answer + bytes([_UNKNOWN_COMMAND])).ljust(_FTP_PAYLOAD_BYTES, b"\0")
    context.link.send(
        dialect.MAVLink_file_transfer_protocol_message(0, *sender(message), list(body))
    )
    return True
