"""Writing a black box: message by message, and onto the disk whenever that is asked for."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from mcap.writer import CompressionType, IndexType, Writer
from pydantic import TypeAdapter

from airl_mav.black_box.messages import SCHEMAS, TOPICS, Message
from airl_mav.core.clock import NS_PER_US

METADATA = "airl-mav"
"""Name of the metadata record that says what flies."""

RUN = "run"
"""Its only key: the object of a `run.json`."""


class BlackBoxFile:
    """An MCAP file that grows.

    It is not written in chunks, and its index comes last: whatever lies on the disk when the power
    fails can be read, up to the last whole message.
    """

    def __init__(self, path: Path, run: Mapping[str, Any]) -> None:
        """Open a new file.

        Args:
            path: Its name, of no file that is there.
            run: What flies, as `run.json` has it.

        Raises:
            OSError: It cannot be opened or written, or is there already.
        """
        self.path = path
        self._file = path.open("xb")
        self._writer = Writer(
            self._file,
            compression=CompressionType.NONE,
            index_types=IndexType.METADATA,
            use_chunking=False,
            enable_data_crcs=True,
        )
        self._writer.start(library="airl-mav")
        self._writer.add_metadata(METADATA, {RUN: json.dumps(run)})
        self._channels: dict[type[Message], int] = {}
        self._adapters = {kind: TypeAdapter(kind) for kind in TOPICS}
        self._sequence = 0

    def write(self, message: Message, unix_us: int) -> None:
        """Add a message of a calendar time [µs]. Raises OSError."""
        kind = type(message)
        if kind not in self._channels:
            self._channels[kind] = self._register(kind)
        self._sequence += 1
        time_ns = unix_us * NS_PER_US
        data = self._adapters[kind].dump_json(message)
        self._writer.add_message(self._channels[kind], time_ns, data, time_ns, self._sequence)

    def _register(self, kind: type[Message]) -> int:
        schema = json.dumps(self._adapters[kind].json_schema())
        number = self._writer.register_schema(SCHEMAS[kind], "jsonschema", schema.encode())
        return self._writer.register_channel(TOPICS[kind], "json", number)

    def sync(self) -> None:
        """Put onto the disk what was written so far. Raises OSError."""
        self._file.flush()
        os.fsync(self._file.fileno())

    def finish(self) -> None:
        """Write the index, and close the file. Raises OSError."""
        self._writer.finish()  # type: ignore[no-untyped-call]
        self.sync()
        self._file.close()

    def abandon(self) -> None:
        """Close the file as it is; what a full disk no longer takes is lost."""
        with suppress(OSError):
            self._file.close()
