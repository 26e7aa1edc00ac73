"""Writer of MCAP files: a black box in flight, or the export of a complete flight."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import IO, Any

from mcap.writer import CompressionType, IndexType, Writer

from airl_mav.black_box.messages import Channel, Message, encoded
from airl_mav.core.clock import NS_PER_US

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
        time_ns = unix_us * NS_PER_US
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
        self._file = path.open("xb")
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
