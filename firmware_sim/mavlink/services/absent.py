"""The protocols of what this vehicle lacks, answered so that a ground station finishes connecting.

FILE_TRANSFER_PROTOCOL: there are no files, and every request is refused; its payload layout:
https://mavlink.io/en/services/ftp.html
"""

from __future__ import annotations

import struct

from firmware_sim.mavlink.codec import WireMessage, dialect
from firmware_sim.mavlink.services.context import Context, sender

_FTP_HEADER = struct.Struct("<HBBBBBxI")
"""Sequence, session, opcode, size, requested opcode, burst complete, padding, offset."""
_FTP_PAYLOAD_BYTES = 251
_OPCODE_ACK, _OPCODE_NAK = 128, 129
_UNKNOWN_COMMAND = 7


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
