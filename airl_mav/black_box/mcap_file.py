"""MCAP files of flights: writing, and reading with the checks of a foreign file."""

from __future__ import annotations

import json
import os
import struct
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any, TypeVar

import zstandard
from mcap import records as mcap_records
from mcap.exceptions import InvalidMagic, McapError
from mcap.records import DataEnd, Metadata
from mcap.stream_reader import CRCValidationError, StreamReader, breakup_chunk
from mcap.writer import CompressionType, IndexType, Writer
from pydantic import TypeAdapter, ValidationError

from airl_mav.black_box.messages import JSON, TOPICS, Channel, Message, encoded
from airl_mav.core import clock, errors, files

METADATA = "airl-mav"
"""Name of the metadata record that describes the run."""

RUN = "run"
"""Only key of the metadata record; its value is the object of a `run.json`."""


class McapFile:
    """MCAP file with the messages of a flight."""

    def __init__(self, file: IO[bytes], run: Mapping[str, Any], *, in_chunks: bool = True) -> None:
        """Start an empty file; chunks are compressed and indexed, but lost in a crash."""
        self._writer = Writer(
            file,
            compression=CompressionType.ZSTD if in_chunks else CompressionType.NONE,
            index_types=IndexType.ALL if in_chunks else IndexType.METADATA,
            use_chunking=in_chunks,
            enable_data_crcs=True,
        )
        self._writer.start(library="airl-mav")
        self._writer.add_metadata(METADATA, {RUN: json.dumps(run)})
        self._channels: dict[Channel, int] = {}
        self._sequence = 0

    def write(self, message: Message, unix_us: int) -> None:
        """Add a message at a calendar time [µs]. Raises OSError."""
        self.add(*encoded(message), unix_us)

    def add(self, channel: Channel, data: bytes, unix_us: int) -> None:
        """Add the encoded message of a channel at a calendar time [µs]. Raises OSError."""
        if channel not in self._channels:
            self._channels[channel] = self._register(channel)
        self._sequence += 1
        time_ns = unix_us * clock.NS_PER_US
        self._writer.add_message(self._channels[channel], time_ns, data, time_ns, self._sequence)

    def _register(self, channel: Channel) -> int:
        number = self._writer.register_schema(
            channel.schema_name, channel.schema_encoding, channel.schema
        )
        return self._writer.register_channel(channel.topic, channel.encoding, number)

    def finish(self) -> None:
        """Write pending data and the index. Raises OSError."""
        self._writer.finish()  # type: ignore[no-untyped-call]


class BlackBoxFile(McapFile):
    """MCAP file without chunks and with the index last; readable after a power failure."""

    def __init__(self, path: Path, run: Mapping[str, Any]) -> None:
        """Open a new file; raise OSError if it exists or cannot be written."""
        self.path = path
        path.touch(mode=0o600, exist_ok=False)
        self._file = path.open("wb")
        super().__init__(self._file, run, in_chunks=False)

    def sync(self) -> None:
        """Flush all written data to the disk. Raises OSError."""
        self._file.flush()
        os.fsync(self._file.fileno())

    def finish(self) -> None:
        """Write the index and close the file. Raises OSError."""
        super().finish()
        self.sync()
        self._file.close()

    def abandon(self) -> None:
        """Close the file as it is; data that a full disk rejects are lost."""
        with suppress(OSError):
            self._file.close()


_RECORD_BYTES = 64 * 2**20
"""Maximum record length; keeps a damaged length field from allocating gigabytes."""

_TORN = (McapError, struct.error, UnicodeDecodeError, ValidationError, zstandard.ZstdError)
"""Exceptions raised for a truncated or damaged record."""

M = TypeVar("M", bound=Message)


@dataclass
class BlackBox:
    """Contents of a black box."""

    path: Path
    run: dict[str, Any]
    """Description of the run as in `run.json`."""
    messages: dict[type[Any], list[Any]] = field(default_factory=dict)
    whole: bool = False
    """True if the file was closed; False after a crash or power failure."""
    damaged: bool = False
    """True if the file was closed but its checksum does not match."""

    def all_of(self, kind: type[M]) -> list[M]:
        """Return the messages of a kind in file order."""
        return self.messages.get(kind, [])


def read_black_box(path: Path) -> BlackBox:
    """Read a black box up to its end or first damage; raise UsageError for other files."""
    box = None
    try:
        with files.open_regular(path) as file:
            reader = StreamReader(
                file, emit_chunks=True, validate_crcs=True, record_size_limit=_RECORD_BYTES
            )
            for record in _whole_records(reader):
                if isinstance(record, Metadata) and record.name == METADATA and box is None:
                    box = BlackBox(path, dict(json.loads(record.metadata[RUN])))
                elif isinstance(record, DataEnd | CRCValidationError) and box is not None:
                    box.whole = True
                    box.damaged = isinstance(record, CRCValidationError)
                elif isinstance(record, tuple) and box is not None:
                    kind, message = record
                    box.messages.setdefault(kind, []).append(message)
    except OSError as error:
        raise errors.UsageError(f"{path}: {error.strerror}") from None
    except (InvalidMagic, KeyError, TypeError, ValueError):
        box = None
    if box is None:
        raise errors.UsageError(f"{path}: accepted: a black box of airl-companion (MCAP)")
    return box


def _records(reader: StreamReader) -> Iterator[Any]:
    """Yield all records. Raises ValueError for a chunk of another program, or too large."""
    for record in reader.records:
        if not isinstance(record, mcap_records.Chunk):
            yield record
            continue
        if record.compression not in ("", "zstd"):
            raise ValueError(f"compression {record.compression}: must be zstd")
        size = record.uncompressed_size
        if record.compression:  # A size within the data has precedence over the chunk's.
            size = max(size, zstandard.frame_content_size(record.data))
        if size > _RECORD_BYTES:
            raise ValueError(f"a chunk of {size:,} bytes: at most {_RECORD_BYTES:,}")
        yield from breakup_chunk(record, validate_crc=True)


def _whole_records(reader: StreamReader) -> Iterator[Any]:
    """Yield metadata, the end record, and messages with their kinds, up to the first damaged one.

    A CRCValidationError replaces the end record if the file's checksum does not match.
    """
    kinds = {topic: kind for kind, topic in TOPICS.items()}
    adapters: dict[int, tuple[type[Message], TypeAdapter[Any]]] = {}
    records = _records(reader)
    while True:
        try:
            record = next(records)
            if isinstance(record, mcap_records.Channel) and record.message_encoding == JSON:
                if record.topic not in kinds:
                    continue
                kind = kinds[record.topic]
                adapters[record.id] = kind, TypeAdapter(kind)
            elif isinstance(record, mcap_records.Message) and record.channel_id in adapters:
                kind, adapter = adapters[record.channel_id]
                yield kind, adapter.validate_json(record.data)
            elif isinstance(record, (Metadata, DataEnd)):
                yield record
        except CRCValidationError as error:
            yield error
            return
        except InvalidMagic:
            if adapters:
                return  # The file is truncated before its closing magic.
            raise
        except (StopIteration, *_TORN):
            return
