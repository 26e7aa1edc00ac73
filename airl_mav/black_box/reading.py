"""Reader of black boxes, including files truncated by a crash."""

from __future__ import annotations

import json
import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

from mcap.exceptions import InvalidMagic, McapError
from mcap.records import Channel, DataEnd, Metadata
from mcap.records import Message as Record
from mcap.stream_reader import CRCValidationError, StreamReader
from pydantic import TypeAdapter, ValidationError

from airl_mav.black_box.messages import JSON, TOPICS, Message
from airl_mav.black_box.writing import METADATA, RUN
from airl_mav.core.errors import UsageError

_RECORD_BYTES = 64 * 2**20
"""Maximum record length; keeps a damaged length field from allocating gigabytes."""

_TORN = (McapError, struct.error, UnicodeDecodeError, ValidationError)
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
        with path.open("rb") as file:
            reader = StreamReader(file, validate_crcs=True, record_size_limit=_RECORD_BYTES)
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
        raise UsageError(f"{path}: {error.strerror}") from None
    except (InvalidMagic, KeyError, TypeError, ValueError):
        box = None
    if box is None:
        raise UsageError(f"{path}: accepted: a black box of airl-companion (MCAP)")
    return box


def _whole_records(reader: StreamReader) -> Iterator[Any]:
    """Yield metadata, the end record, and messages with their kinds, up to the first damaged one.

    A CRCValidationError replaces the end record if the file's checksum does not match.
    """
    kinds = {topic: kind for kind, topic in TOPICS.items()}
    adapters: dict[int, tuple[type[Message], TypeAdapter[Any]]] = {}
    records = reader.records
    while True:
        try:
            record = next(records)
            if isinstance(record, Channel) and record.message_encoding == JSON:
                if record.topic not in kinds:
                    continue
                kind = kinds[record.topic]
                adapters[record.id] = kind, TypeAdapter(kind)
            elif isinstance(record, Record) and record.channel_id in adapters:
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
