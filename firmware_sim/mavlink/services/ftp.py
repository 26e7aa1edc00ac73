"""FILE_TRANSFER_PROTOCOL: there are no files; every request is refused, so that clients proceed.

Payload layout: https://mavlink.io/en/services/ftp.html
"""

from __future__ import annotations

import struct

from firmware_sim.mavlink.codec import WireMessage, dialect
from firmware_sim.mavlink.services.context import Context, Handler, for_vehicle_or_all, sender

_HEADER = struct.Struct("<HBBBBBxI")
"""Sequence, session, opcode, size, requested opcode, burst complete, padding, offset."""
_PAYLOAD_BYTES = 251
_OPCODE_ACK, _OPCODE_NAK = 128, 129
_UNKNOWN_COMMAND = 7


def handle_request(message: WireMessage, context: Context) -> bool:
    """Answer a request with NAK "unknown command"."""
    if not for_vehicle_or_all(message):
        return False
    sequence, session, opcode, *_ = _HEADER.unpack_from(bytes(message.payload))
    if opcode in (_OPCODE_ACK, _OPCODE_NAK):
        return False
    answer = _HEADER.pack((sequence + 1) & 0xFFFF, session, _OPCODE_NAK, 1, opcode, 0, 0)
    body = (answer + bytes([_UNKNOWN_COMMAND])).ljust(_PAYLOAD_BYTES, b"\0")
    context.link.send(
        dialect.MAVLink_file_transfer_protocol_message(0, *sender(message), list(body))
    )
    return True


HANDLERS: dict[str, Handler] = {"FILE_TRANSFER_PROTOCOL": handle_request}
