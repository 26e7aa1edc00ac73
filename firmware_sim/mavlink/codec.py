"""MAVLink 2 codec and its dialect. Only this module imports pymavlink.

pymavlink provides only the generated dialect (`dialect`): message classes, constants and the
decoder of one whole frame. Its `development` set includes all of `common`, but lacks the newest
messages of PX4: EVENT, COMPONENT_METADATA, TIME_ESTIMATE_TO_TARGET and others.
`newer_messages.xml` defines these messages. The first import after an install generates a module
from both (a fraction of a second) and caches it beside the compiled kernels.

 Framing is implemented here. On reception, pymavlink's parser waits for
the full payload that a damaged header announces, and discards it. For streams, creating and packing
a message object takes several times as long as `WireLayout` and `Encoder.frame`.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import importlib.util
import inspect
import io
import re
import struct
import sys
import tempfile
import zlib
from collections.abc import Callable, Sequence
from itertools import accumulate
from operator import itemgetter
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, TypeAlias
from xml.etree import ElementTree as Xml

import pymavlink
from pymavlink.generator import mavcrc

from airl_mav.core.compiling import writable_folder

NEWER = Path(__file__).with_name("newer_messages.xml")
"""Messages missing from pymavlink's definitions."""

DEFINITIONS = Path(pymavlink.__file__).parent / "dialects" / "v20"
INCLUDED = ("minimal", "standard", "common", "development")
"""pymavlink's definitions included in `development`, each including the one before."""

_NAME = "airl_mavlink_dialect"


def load_dialect() -> ModuleType:
    """Return the dialect module, the counterpart of `pymavlink.dialects.v20.common`.

    Raises:
        ImportError: pymavlink is installed without its message definitions.
    """
    present = sys.modules.get(_NAME)
    if present is not None:
        return present
    # Without a writable folder, each process generates its own module.
    folder = writable_folder(f"mavlink-{_digest()}")
    if folder is not None:
        return _imported(generated(folder))
    with tempfile.TemporaryDirectory() as temporary:
        return _imported(generated(Path(temporary)))


def _digest() -> str:
    """Return a digest of the module's source definitions."""
    digest = hashlib.sha256(NEWER.read_bytes())
    for name in INCLUDED:
        # Size and time reveal an upgrade of pymavlink without reading half a megabyte of text.
        try:
            info = (DEFINITIONS / f"{name}.xml").stat()
        except OSError as error:
            raise ImportError(f"pymavlink lacks its message definitions: {error}") from error
        digest.update(f"{name} {info.st_size} {info.st_mtime_ns}".encode())
    return digest.hexdigest()[:16]


def generated(folder: Path) -> Path:
    """Return the path of the module in a folder. Generates a missing module."""
    path = folder / f"{_NAME}.py"
    # A temporary folder hides the half-written module from other processes.
    if not path.is_file():
        with tempfile.TemporaryDirectory(dir=folder) as temporary:
            made = Path(temporary) / path.name
            generate(NEWER, DEFINITIONS, INCLUDED, made)
            made.replace(path)  # atomic, for several processes at once
    return path


def _imported(path: Path) -> ModuleType:
    spec = importlib.util.spec_from_file_location(_NAME, path)
    if spec is None or spec.loader is None:
        raise ImportError(f"{path}: cannot be imported")
    module = importlib.util.module_from_spec(spec)
    # Registered before execution, as in importlib's documentation.
    sys.modules[_NAME] = module
    try:
        spec.loader.exec_module(module)
    except BaseException:
        del sys.modules[_NAME]
        raise
    return module


def generate(newer: Path, definitions: Path, included: tuple[str, ...], module: Path) -> None:
    """Write the Python module of a dialect.

    Args:
        newer: Additional definitions; they replace messages with the same number.
        definitions: Folder of pymavlink's definitions.
        included: Definitions of the dialect, each including the one before.
        module: File to write, in an empty folder. Definitions are written there, too.

    Raises:
        ImportError: The generator rejects the definitions.
    """
    # Imported here because loading an existing module does not need the generator.
    from pymavlink.generator import mavgen

    folder = module.parent
    root = Xml.parse(newer).getroot()  # noqa: S314 (our own file)
    # A newer definition replaces pymavlink's message with the same number.
    numbers = {message.get("id") for message in root.iter("message")}
    for name in included:
        tree = Xml.parse(definitions / f"{name}.xml")  # noqa: S314 (pymavlink's own file)
        for messages in tree.getroot().iter("messages"):
            for message in [m for m in messages if m.get("id") in numbers]:
                messages.remove(message)
        tree.write(folder / f"{name}.xml")
    # Include and version come first, as in pymavlink's own files.
    include, version = Xml.Element("include"), Xml.Element("version")
    include.text = f"{included[-1]}.xml"
    version.text = "3"  # HEARTBEAT's mavlink_version, as in minimal.xml
    root[:0] = [include, version]
    source = module.with_suffix(".xml")
    Xml.ElementTree(root).write(source)
    options = mavgen.Opts(
        str(module.with_suffix("")), wire_protocol="2.0", language="Python3", validate=False
    )
    output = io.StringIO()
    # In a rehearsal, a process's standard output is its channel to the harness.
    with contextlib.redirect_stdout(output), contextlib.redirect_stderr(output):
        made = mavgen.mavgen(options, [str(source)])
    if not made:
        raise ImportError(f"pymavlink's generator failed: {output.getvalue()}")


if TYPE_CHECKING:
    from pymavlink.dialects.v20 import development

    dialect = development
    WireMessage: TypeAlias = development.MAVLink_message
else:
    dialect = load_dialect()
    WireMessage = dialect.MAVLink_message
    """Received message, or a message to pack."""

Values: TypeAlias = Sequence[float]
"""Fields of a message in order of definition, with int values for integer fields. Arrays are
unrolled. Extension fields (the last ones) are optional and default to zero."""

SYSTEM_ID = 1
"""MAVLink system id of the vehicle (PX4's MAV_SYS_ID default)."""

COMPONENT_ID: int = dialect.MAV_COMP_ID_AUTOPILOT1

_MARKER_V1, _MARKER_V2 = 0xFE, 0xFD
_HEADER_V1, _HEADER_V2 = 6, 10
_CHECKSUM, _SIGNATURE = 2, 13
_FLAG_SIGNED = 0x01

MOST_DAMAGED = 64
"""Maximum number of damaged frames in a chunk; the rest of the chunk is then dropped. Each one
costs as much as a valid frame, and a hostile chunk can contain one at every byte."""

_MARK_V2 = bytes([_MARKER_V2])
_HEADER_PACK = struct.Struct("<BBBB2s3s").pack
"""MAVLink 2 header after its marker: length, flags (two), sequence, sender, message id."""

_FIELD_FORMAT = re.compile(r"\d*[a-zA-Z]")
"""Pattern of one field in a struct format: 21f, 50s, B."""

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
    """Return True if a received message has a signature, valid or not."""
    frame: bytearray = message.get_msgbuf()
    return frame[0] == _MARKER_V2 and bool(frame[2] & _FLAG_SIGNED)


def param_value(name: str, raw: bytes, kind: int, count: int, index: int) -> bytes:
    """Return the payload of a PARAM_VALUE.

    An INT32 parameter is sent as the bytes of a float (PX4's bytewise encoding). A Python float
    would change integers whose bits form a signalling NaN.

    The name has at most 16 characters. `raw` is the value's four bytes, little endian; `kind` is
    their MAV_PARAM_TYPE. `count` is the number of parameters; index 65535 = not in the list.
    """
    return _PARAM_VALUE.pack(raw, count, index, name.encode("ascii"), kind)


class WireLayout:
    """Wire layout of one message, from pymavlink's message class."""

    def __init__(self, kind: type[WireMessage]) -> None:
        self.id_bytes: bytes = kind.id.to_bytes(3, "little")
        self.crc_extra = bytes([kind.crc_extra])
        # Wire order sorts fields by size; `Values` follows the order of definition in the XML.
        names = kind.ordered_fieldnames
        formats = dict(zip(names, _FIELD_FORMAT.findall(kind.unpacker.format), strict=True))
        sizes = dict(zip(names, kind.lengths, strict=True))
        starts = accumulate((sizes[n] for n in kind.fieldnames), initial=0)
        firsts = dict(zip(kind.fieldnames, starts, strict=False))  # the last one is the end
        self._packers: dict[int, _Packer] = {}
        # One packer per number of extension fields that a caller may omit.
        # Extension fields are last on the wire too: omitting them shortens the payload.
        for end in range(len(names) - len(_extension_fields(kind)), len(names) + 1):
            slots = [firsts[n] + i for n in names[:end] for i in range(sizes[n])]
            pack = struct.Struct("<" + "".join(formats[n] for n in names[:end])).pack
            # Many messages are defined in wire order and need no sorting.
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
def layout(name: str) -> WireLayout:
    """Return the layout of a message such as "ATTITUDE". Raises AttributeError when unknown."""
    return WireLayout(dialect.mavlink_map[message_id(name)])


def _x25(data: bytes) -> int:
    crc: int = mavcrc.x25crc(data).crc
    return crc


# CRC-16/MCRF4XX. pymavlink's x25crc is a class around fastcrc's function (not available on every
# platform). Creating an x25crc object takes longer than the checksum.
_checksum: Callable[[bytes], int] = _x25 if mavcrc.mcrf4xx is None else mavcrc.mcrf4xx


def _extension_fields(kind: type[WireMessage]) -> list[str]:
    """Return the names of extension fields: the parameters with a default in pymavlink."""
    parameters = inspect.signature(kind).parameters.values()
    return [p.name for p in parameters if p.default is not inspect.Parameter.empty]


class Encoder:
    """Message packer of one link, with the vehicle's ids and the link's sequence numbers."""

    def __init__(self, system_id: int = SYSTEM_ID, component_id: int = COMPONENT_ID) -> None:
        self._mav = dialect.MAVLink(None, srcSystem=system_id, srcComponent=component_id)
        self.sequence = 0
        """Sequence number of the next frame."""
        self._component_id = component_id
        self.identify(system_id)

    def identify(self, system_id: int) -> None:
        """Change the system id of the sender. Sequence numbers continue."""
        self._mav.srcSystem = self.system_id = system_id
        self._ids = bytes([system_id, self._component_id])

    def skip(self, frames: int) -> None:
        """Advance the sequence number by frames packed elsewhere."""
        self.sequence = (self.sequence + frames) & 0xFF

    def pack(self, message: WireMessage) -> bytes:
        """Return the frame of a message.

        Raises struct.error or OverflowError when a field does not fit its type.
        """
        self._mav.seq = self.sequence
        frame: bytes = message.pack(self._mav)
        self.sequence = (self.sequence + 1) & 0xFF
        return frame

    def frame(self, layout: WireLayout, payload: bytes) -> bytes:
        """Return a frame for a payload of this layout, identical to the result of `pack`."""
        seq = self.sequence
        self.sequence = (seq + 1) & 0xFF
        covered = _HEADER_PACK(len(payload), 0, 0, seq, self._ids, layout.id_bytes) + payload
        return _MARK_V2 + covered + _checksum(covered + layout.crc_extra).to_bytes(2, "little")


class Reader:
    """Fast decoder for chunks that contain exactly one frame of one message type.

    `read` takes a tenth of the time of `Decoder`, which handles all other input.
    """

    def __init__(self, name: str) -> None:
        """Prepare to decode a message such as "ATTITUDE". Raises AttributeError when unknown."""
        kind = dialect.mavlink_map[message_id(name)]
        self.names: tuple[str, ...] = tuple(kind.ordered_fieldnames)
        """Field names in wire order; one name per array."""
        self._wire: struct.Struct = kind.unpacker
        self._id: bytes = kind.id.to_bytes(3, "little")
        self._crc_extra = bytes([kind.crc_extra])

    def read(self, chunk: bytes) -> tuple[float, ...] | None:
        """Return the values in wire order, arrays unrolled.

        None unless the chunk is exactly one valid, unsigned MAVLink 2 frame of this message.
        """
        # Byte 2 holds the incompatibility flags: a signed frame needs `Decoder`.
        if len(chunk) < _HEADER_V2 + _CHECKSUM or chunk[0] != _MARKER_V2 or chunk[2] != 0:
            return None
        end = _HEADER_V2 + chunk[1]
        if len(chunk) != end + _CHECKSUM or chunk[7:10] != self._id:
            return None
        # CRC_EXTRA covers the message definition, so a different field layout fails here.
        if _checksum(chunk[1:end] + self._crc_extra) != int.from_bytes(chunk[end:], "little"):
            return None
        # MAVLink 2 omits trailing zeros.
        # The slice also drops extension fields that are newer than this dialect.
        size = self._wire.size
        return self._wire.unpack(chunk[_HEADER_V2:end][:size].ljust(size, b"\0"))


class Decoder:
    """Parser for MAVLink 1 and 2 frames in arbitrary bytes. Never raises; memory is bounded.

    After a damaged frame the search resumes at its second byte, so a valid frame behind a false or
    truncated header is not lost. Signatures are not checked, because this class has no key.
    """

    def __init__(self, *, datagrams: bool) -> None:
        """Start empty.

        `datagrams`: True if every chunk holds whole frames (UDP). False for a byte stream (serial),
        where a frame may continue in the next chunk.
        """
        self.malformed = 0
        """Number of byte runs that belong to no valid frame."""
        self.unknown = 0
        """Number of frames with an unknown message, whose checksum cannot be checked."""
        self._datagrams = datagrams
        self._rest = b""
        self._in_garbage = False
        self._mav = dialect.MAVLink(None)

    @property
    def between_frames(self) -> bool:
        """True if the next chunk is expected to start a frame."""
        return not self._rest and not self._in_garbage

    def feed(self, data: bytes) -> list[WireMessage]:
        """Return the messages completed by a chunk of bytes."""
        buffer = self._rest + data
        self._rest = b""
        found: list[WireMessage] = []
        start = damaged = 0
        # Each pass consumes one frame, or one byte that starts no valid frame.
        while start < len(buffer):
            end = _frame_end(buffer, start)
            # In a datagram a frame cannot continue: the header is false or truncated.
            if end is not None and end > len(buffer):
                if not self._datagrams:
                    # Bounded: a frame claims at most 280 bytes.
                    self._rest = buffer[start:]
                    return found
                end = None
            message = None if end is None else self._decode(buffer, start, end)
            damaged += end is not None and message is None
            # Only frames with a plausible header count: other bytes are cheap to skip.
            if damaged > MOST_DAMAGED:
                self.malformed += not self._in_garbage
                self._in_garbage = not self._datagrams
                return found
            if end is None or message is None:
                # A run of garbage counts once, however many bytes it has.
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
        # The next datagram starts a new run.
        if self._datagrams:
            self._in_garbage = False
        return found

    def _decode(self, buffer: bytes, start: int, end: int) -> WireMessage | None:
        try:
            message = self._mav.decode(bytearray(buffer[start:end]))
        except (dialect.MAVError, struct.error):
            return None
        if isinstance(message, dialect.MAVLink_unknown):
            # The checksum cannot be checked: accept the frame only where one may end.
            fits = end == len(buffer) or buffer[end] in (_MARKER_V1, _MARKER_V2)
            return message if fits else None
        return message


def _frame_end(buffer: bytes, start: int) -> int | None:
    """Return the end of the frame at `start` (possibly past the buffer), None if not a frame."""
    # A header that is cut off after the marker claims the shortest frame.
    marker, left = buffer[start], len(buffer) - start
    if marker == _MARKER_V1:
        length = buffer[start + 1] if left > 1 else 0
        return start + _HEADER_V1 + length + _CHECKSUM
    if marker != _MARKER_V2:
        return None
    length = buffer[start + 1] if left > 1 else 0
    flags = buffer[start + 2] if left > 2 else 0
    if flags & ~_FLAG_SIGNED:
        return None  # unsupported flag: the specification requires dropping the frame
    signature = _SIGNATURE if flags & _FLAG_SIGNED else 0
    return start + _HEADER_V2 + length + _CHECKSUM + signature


# --- texts


_ALL_ONES = 0xFFFF_FFFF


def crc32part(data: bytes, crc: int = 0) -> int:
    """Return the CRC-32 of preceding data (`crc`) and `data`.

    zlib inverts before and after; PX4's crc32part() does not.
    """
    return zlib.crc32(data, crc ^ _ALL_ONES) ^ _ALL_ONES
