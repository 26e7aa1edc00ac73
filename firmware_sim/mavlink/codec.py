"""The MAVLink 2 codec: the only module that touches pymavlink.

Of pymavlink only the generated dialect (`dialect`) is used: message classes, constants and the
decoder of one whole frame. Framing is done here. When receiving, because pymavlink's own parser
discards everything that a damaged header claims as its payload, and waits for it to arrive. When
streaming, because creating and packing a message object costs several times as much as `Layout`
and `Encoder.frame`, which take the layout of a message from pymavlink's classes.
"""

from __future__ import annotations

import functools
import inspect
import re
import struct
from collections.abc import Callable, Sequence
from itertools import accumulate
from operator import itemgetter
from typing import TYPE_CHECKING, TypeAlias

from pymavlink.generator import mavcrc

from firmware_sim.autopilot.autopilot_state import Message
from firmware_sim.mavlink.dialect import load

if TYPE_CHECKING:
    from pymavlink.dialects.v20 import development as dialect
else:
    dialect = load()

__all__ = [
    "COMPONENT_ID",
    "SYSTEM_ID",
    "Decoder",
    "Encoder",
    "Layout",
    "Reader",
    "TextEncoder",
    "Values",
    "WireMessage",
    "dialect",
    "is_signed",
    "layout",
    "message_id",
    "message_name",
    "param_value",
    "payload",
    "trimmed",
]

WireMessage: TypeAlias = dialect.MAVLink_message
"""A decoded message, or one to be packed."""

Values: TypeAlias = Sequence[float]
"""The fields of a message in the order of their definition, ints where a field is one. Arrays are
unrolled; extension fields (the last ones) may be left out and are zero then."""

SYSTEM_ID = 1
"""MAVLink system id of the vehicle (PX4's MAV_SYS_ID default)."""

COMPONENT_ID: int = dialect.MAV_COMP_ID_AUTOPILOT1

_MARKER_V1, _MARKER_V2 = 0xFE, 0xFD
_HEADER_V1, _HEADER_V2 = 6, 10
_CHECKSUM, _SIGNATURE = 2, 13
_FLAG_SIGNED = 0x01

MOST_DAMAGED = 64
"""Damaged frames in one chunk after which the rest of it is dropped: each costs as much as a valid
one, and a hostile chunk can seem to begin one at every byte."""

_MARK_V2 = bytes([_MARKER_V2])
_HEADER_PACK = struct.Struct("<BBBB2s3s").pack
"""The MAVLink 2 header behind its marker: length, flags (two), sequence, sender, message id."""

_FIELD_FORMAT = re.compile(r"\d*[a-zA-Z]")
"""One field in a struct format: 21f, 50s, B."""

_Sort: TypeAlias = Callable[[Sequence[float]], Sequence[float]]
_Packer: TypeAlias = tuple[_Sort | None, Callable[..., bytes]]

_PARAM_VALUE = struct.Struct("<4sHH16sB")


def message_id(name: str) -> int:
    """Return the message id of a name such as "ATTITUDE". Raises AttributeError when unknown."""
    number: int = getattr(dialect, f"MAVLINK_MSG_ID_{name}")
    return number


def message_name(number: int) -> str | None:
    """Return the name of a message id, such as "ATTITUDE"; None when unknown."""
    kind = dialect.mavlink_map.get(number)
    return None if kind is None else str(kind.msgname)


def payload(message: WireMessage) -> bytes:
    """Return the payload of a received message as sent: without trailing zeros (MAVLink 2)."""
    frame: bytearray = message.get_msgbuf()
    start = _HEADER_V2 if frame[0] == _MARKER_V2 else _HEADER_V1
    return bytes(frame[start : start + frame[1]])


def is_signed(message: WireMessage) -> bool:
    """Return whether a received message has a signature, right or wrong."""
    frame: bytearray = message.get_msgbuf()
    return frame[0] == _MARKER_V2 and bool(frame[2] & _FLAG_SIGNED)


def param_value(name: str, raw: bytes, kind: int, count: int, index: int) -> bytes:
    """Return the payload of a PARAM_VALUE.

    An INT32 parameter travels as the bytes of a float (PX4's bytewise encoding). Integers whose
    bits form a signalling NaN would change on their way through a Python float.

    The name has at most 16 characters; `raw` is the value's four bytes, little endian, and `kind`
    their MAV_PARAM_TYPE; `count` is the number of parameters; index 65535 = it has none.
    """
    return _PARAM_VALUE.pack(raw, count, index, name.encode("ascii"), kind)


class Layout:
    """The wire layout of one message, taken from pymavlink's class."""

    def __init__(self, kind: type[WireMessage]) -> None:
        self.id_bytes: bytes = kind.id.to_bytes(3, "little")
        self.crc_extra = bytes([kind.crc_extra])
        names = kind.ordered_fieldnames
        formats = dict(zip(names, _FIELD_FORMAT.findall(kind.unpacker.format), strict=True))
        sizes = dict(zip(names, kind.lengths, strict=True))
        starts = accumulate((sizes[n] for n in kind.fieldnames), initial=0)
        firsts = dict(zip(kind.fieldnames, starts, strict=False))  # the last one is the end
        self._packers: dict[int, _Packer] = {}
        # Extension fields come last on the wire too: without them a payload is a shorter one.
        for end in range(len(names) - len(_extension_fields(kind)), len(names) + 1):
            slots = [firsts[n] + i for n in names[:end] for i in range(sizes[n])]
            pack = struct.Struct("<" + "".join(formats[n] for n in names[:end])).pack
            # Many messages are defined in the order of the wire: nothing to sort there.
            in_order = slots == sorted(slots)
            self._packers[len(slots)] = (None if in_order else itemgetter(*slots), pack)

    def payload(self, values: Values) -> bytes:
        """Return the payload without its trailing zeros, which MAVLink 2 does not send.

        Raises struct.error or OverflowError when a value does not fit its field.
        """
        try:
            sort, pack = self._packers[len(values)]
        except KeyError:
            counts = sorted(self._packers)
            raise struct.error(f"{len(values)} values, expected {counts}") from None
        return trimmed(pack(*values) if sort is None else pack(*sort(values)))


def trimmed(payload: bytes) -> bytes:
    """Return a payload without its trailing zeros, which MAVLink 2 does not send."""
    return payload.rstrip(b"\0") or b"\0"


@functools.cache
def layout(name: str) -> Layout:
    """Return the layout of a message such as "ATTITUDE". Raises AttributeError when unknown."""
    return Layout(dialect.mavlink_map[message_id(name)])


def _x25(data: bytes) -> int:
    crc: int = mavcrc.x25crc(data).crc
    return crc


# CRC-16/MCRF4XX. pymavlink's x25crc is a class around fastcrc's function (which a platform may
# lack): making its object would cost more than the checksum.
_checksum: Callable[[bytes], int] = _x25 if mavcrc.mcrf4xx is None else mavcrc.mcrf4xx


def _extension_fields(kind: type[WireMessage]) -> list[str]:
    """Return the extension fields: pymavlink gives them, and only them, a default."""
    parameters = inspect.signature(kind).parameters.values()
    return [p.name for p in parameters if p.default is not inspect.Parameter.empty]


class Encoder:
    """Packs the messages of one link: the vehicle's ids and the link's own sequence numbers."""

    def __init__(self, system_id: int = SYSTEM_ID, component_id: int = COMPONENT_ID) -> None:
        self._mav = dialect.MAVLink(None, srcSystem=system_id, srcComponent=component_id)
        self.sequence = 0
        """Sequence number of the next frame."""
        self._component_id = component_id
        self.identify(system_id)

    def identify(self, system_id: int) -> None:
        """Send as another system from now on. The sequence goes on."""
        self._mav.srcSystem = self.system_id = system_id
        self._ids = bytes([system_id, self._component_id])

    def skip(self, frames: int) -> None:
        """Count frames that something else has packed."""
        self.sequence = (self.sequence + frames) & 0xFF

    def pack(self, message: WireMessage) -> bytes:
        """Return the frame of a message.

        Raises struct.error or OverflowError when a field does not fit its type.
        """
        self._mav.seq = self.sequence
        frame: bytes = message.pack(self._mav)
        self.sequence = (self.sequence + 1) & 0xFF
        return frame

    def frame(self, layout: Layout, payload: bytes) -> bytes:
        """Return the frame around a payload of that layout: what `pack` makes of the message."""
        seq = self.sequence
        self.sequence = (seq + 1) & 0xFF
        covered = _HEADER_PACK(len(payload), 0, 0, seq, self._ids, layout.id_bytes) + payload
        return _MARK_V2 + covered + _checksum(covered + layout.crc_extra).to_bytes(2, "little")


class Reader:
    """Reads one kind of message where a chunk of bytes is one whole frame of it.

    That takes a tenth of what `Decoder` does, which everything else is left to.
    """

    def __init__(self, name: str) -> None:
        """Take a name such as "ATTITUDE". Raises AttributeError when unknown."""
        kind = dialect.mavlink_map[message_id(name)]
        self.names: tuple[str, ...] = tuple(kind.ordered_fieldnames)
        """The fields in the order in which they are sent; an array has its name once."""
        self._wire: struct.Struct = kind.unpacker
        self._id: bytes = kind.id.to_bytes(3, "little")
        self._crc_extra = bytes([kind.crc_extra])

    def read(self, chunk: bytes) -> tuple[float, ...] | None:
        """Return the values in the order in which they are sent, arrays unrolled.

        None where the chunk is anything but one valid, unsigned MAVLink 2 frame of this message.
        """
        if len(chunk) < _HEADER_V2 + _CHECKSUM or chunk[0] != _MARKER_V2 or chunk[2] != 0:
            return None
        end = _HEADER_V2 + chunk[1]
        if len(chunk) != end + _CHECKSUM or chunk[7:10] != self._id:
            return None
        if _checksum(chunk[1:end] + self._crc_extra) != int.from_bytes(chunk[end:], "little"):
            return None
        # Zeros at its end are not sent.
        size = self._wire.size
        return self._wire.unpack(chunk[_HEADER_V2:end][:size].ljust(size, b"\0"))


class Decoder:
    """Finds MAVLink 1 and 2 frames in arbitrary bytes. Never raises, never grows.

    After a damaged frame the search goes on at its second byte, so a valid frame hidden behind a
    false or cut header is not lost. Signatures are not checked: there is no key.
    """

    def __init__(self, *, datagrams: bool) -> None:
        """Start empty.

        `datagrams`: every chunk holds whole frames (UDP); else it is a byte stream (serial), where
        a frame may be continued in the next chunk.
        """
        self.malformed = 0
        """Runs of bytes that belong to no valid frame."""
        self.unknown = 0
        """Frames whose message the dialect lacks, so that their checksum cannot be checked."""
        self._datagrams = datagrams
        self._rest = b""
        self._in_garbage = False
        self._mav = dialect.MAVLink(None)

    @property
    def between_frames(self) -> bool:
        """Whether the next chunk begins a frame, as far as is known."""
        return not self._rest and not self._in_garbage

    def feed(self, data: bytes) -> list[WireMessage]:
        """Return the messages completed by a chunk of bytes."""
        buffer = self._rest + data
        self._rest = b""
        found: list[WireMessage] = []
        start = damaged = 0
        while start < len(buffer):
            end = _frame_end(buffer, start)
            if end is not None and end > len(buffer):
                if not self._datagrams:
                    # Bounded: a frame claims at most 280 bytes.
                    self._rest = buffer[start:]
                    return found
                end = None
            message = None if end is None else self._decode(buffer, start, end)
            damaged += end is not None and message is None
            if damaged > MOST_DAMAGED:
                self.malformed += not self._in_garbage
                self._in_garbage = not self._datagrams
                return found
            if end is None or message is None:
                self.malformed += not self._in_garbage
                self._in_garbage = True
                start += 1
                continue
            self._in_garbage = False
            start = end
            if isinstance(message, dialect.MAVLink_unknown):
                self.unknown += 1
            else:
                found.append(message)
        if self._datagrams:
            self._in_garbage = False
        return found

    def _decode(self, buffer: bytes, start: int, end: int) -> WireMessage | None:
        try:
            message = self._mav.decode(bytearray(buffer[start:end]))
        except (dialect.MAVError, struct.error):
            return None
        if isinstance(message, dialect.MAVLink_unknown):
            # No checksum to trust: believe it only where a frame may really end.
            fits = end == len(buffer) or buffer[end] in (_MARKER_V1, _MARKER_V2)
            return message if fits else None
        return message


def _frame_end(buffer: bytes, start: int) -> int | None:
    """Return where the frame at `start` ends (maybe past the buffer), None if there is none."""
    marker, left = buffer[start], len(buffer) - start
    if marker == _MARKER_V1:
        length = buffer[start + 1] if left > 1 else 0
        return start + _HEADER_V1 + length + _CHECKSUM
    if marker != _MARKER_V2:
        return None
    length = buffer[start + 1] if left > 1 else 0
    flags = buffer[start + 2] if left > 2 else 0
    if flags & ~_FLAG_SIGNED:
        return None  # incompatible with anything known: the specification says to drop it
    signature = _SIGNATURE if flags & _FLAG_SIGNED else 0
    return start + _HEADER_V2 + length + _CHECKSUM + signature


# --- texts

CHUNK_BYTES = 50
_LAST_ID = 65_535

SAID_BY_EVENT = b"\t"
"""Ends a text that is an event, too, as PX4's do: ground stations that know events pass it over."""

REPLY_IDS = 32_768
"""First id of answers that are counted apart from the autopilot's texts: the ids of two consecutive
long texts must differ."""


class TextEncoder:
    """Turns texts into STATUSTEXT messages, with the ids that tie the chunks together."""

    def __init__(self, last_id: int = 0) -> None:
        """Give the first long text the id after `last_id`."""
        self._id = last_id

    def encode(self, message: Message) -> list[WireMessage]:
        """Return the messages of one text, in order.

        A text of up to 50 characters is one message with id 0. A longer one is chunks with one id.
        A chunk with a NUL in it is the last, so a text that fills its last chunk to the brim is
        followed by an empty one.
        """
        text = message.text.encode("ascii", errors="replace")
        if message.event is not None:
            text += SAID_BY_EVENT
        if len(text) <= CHUNK_BYTES:
            return [dialect.MAVLink_statustext_message(message.severity, text)]
        self._id = self._id % _LAST_ID + 1
        starts = range(0, len(text) + 1, CHUNK_BYTES)
        return [
            dialect.MAVLink_statustext_message(
                message.severity, text[start : start + CHUNK_BYTES], self._id, chunk
            )
            for chunk, start in enumerate(starts)
        ]
