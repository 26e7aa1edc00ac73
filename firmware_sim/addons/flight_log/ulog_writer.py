"""ULog, PX4's log format: topic definitions and a streaming writer.

Format: https://docs.px4.io/main/en/dev_log/ulog_file_format.html, version 1. Little endian; every
message consists of content length, type and content.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from airl_mav.core.files import LogFile

Values = tuple[float | int | bool, ...]

_MAGIC = b"\x55\x4c\x6f\x67\x01\x12\x35"
_VERSION = 1
_HEAD = struct.Struct("<HB")
_HEADER = ("_size", "<u2"), ("_type", "u1"), ("_id", "<u2")
"""Fields of a sample before its timestamp."""

HEAD_BYTES = 13
"""Size of these fields and of the timestamp."""

_FLAG_BYTES = 40
"""Content of the flag message: compatible and incompatible flags, offsets of appended data."""

_CODES = {
    "int8_t": "b",
    "uint8_t": "B",
    "int16_t": "h",
    "uint16_t": "H",
    "int32_t": "i",
    "uint32_t": "I",
    "int64_t": "q",
    "uint64_t": "Q",
    "float": "f",
    "double": "d",
    "bool": "?",
}


@dataclass(frozen=True)
class Topic:
    """Topic of uORB: name and fields, each "type name" or "type[n] name"."""

    name: str
    fields: tuple[str, ...]
    """Fields after the timestamp, the first field of every topic."""
    constants: Mapping[str, float] = field(default_factory=dict)
    """Values of fields that never change."""
    parts: Mapping[str, Topic] = field(default_factory=dict)
    """Topics that are types of fields, by name."""

    @cached_property
    def definition(self) -> bytes:
        """Content of the format message."""
        return f"{self.name}:{';'.join(('uint64_t timestamp', *self.fields))};".encode("ascii")

    @cached_property
    def content(self) -> list[Any]:
        """Timestamp and fields as fields of a dtype."""
        found: list[Any] = [("timestamp", "<u8")]
        for each in self.fields:
            (kind, _, count), name = each.split()[0].rstrip("]").partition("["), each.split()[1]
            if part := self.parts.get(kind):
                found += [(f"{name}.{inner}", *rest) for inner, *rest in part.content]
            else:
                found.append((name, f"<{_CODES[kind]}", *([int(count)] if count else [])))
        return found

    @cached_property
    def blank(self) -> NDArray[Any]:
        """Message without values (1,): a float is NaN, an integer 0, a bool false."""
        blank = np.zeros(1, np.dtype([*_HEADER, *self.content]))
        for name in blank.dtype.names or ():
            if blank[name].dtype.kind == "f":
                blank[name] = np.nan
        blank["_size"], blank["_type"] = blank.dtype.itemsize - _HEAD.size, ord("D")
        for name, value in self.constants.items():
            blank[name] = value
        return blank

    def rows(self, times_us: Any, columns: Mapping[str, Any]) -> NDArray[Any]:
        """Return messages (n,) with values (n, ...) of fields by name; the others are blank.

        Values beyond single precision become infinite, as on real hardware.
        """
        rows = self.blank.repeat(len(times_us))
        rows["timestamp"] = times_us
        with np.errstate(over="ignore"):
            for name, value in columns.items():
                # A field of another topic's type has values by its fields.
                if isinstance(value, Mapping):
                    for inner, each in value.items():
                        rows[f"{name}.{inner}"] = each
                else:
                    rows[name] = value
        return rows

    def row(self, time_us: int, values: Values) -> NDArray[Any]:
        """Return a message (1,) with the values of all fields in order; check their number."""
        columns, rest = {}, list(values)
        for name, _, *shape in self.content[1:]:
            count = shape[0] if shape else 1
            columns[name], rest = rest[:count] if shape else rest[0], rest[count:]
        if rest:
            raise ValueError(f"{self.name}: {len(rest)} values too many")
        return self.rows((time_us,), columns)


class UlogWriter(LogFile):
    """Writer of a log of samples, texts and parameters."""

    def __init__(
        self,
        path: Path,
        start_us: int,
        topics: Iterable[Topic],
        info: Iterable[tuple[str, str | int]],
        parameters: Iterable[tuple[str, int | float]],
        on_lost: Callable[[str], None] = lambda _: None,
    ) -> None:
        """Open the file with final name `path` and write the head; for `on_lost` see `LogFile`.

        The index of a topic is the number for `sample`. Info has ULog keys; the type of a number
        is in its key, default uint32_t. An int parameter is written as int32_t.
        """
        super().__init__(path, on_lost)
        self._topics = topics = tuple(topics)
        self._now_us = start_us
        self.add(start_us, _MAGIC, struct.pack("<BQ", _VERSION, start_us))
        self._message(b"B", bytes(_FLAG_BYTES))
        formats = {each.name: each for topic in topics for each in (topic, *topic.parts.values())}
        for each in formats.values():
            self._message(b"F", each.definition)
        for key, value in info:
            kind, _, name = key.rpartition(" ")
            code = f"<{_CODES[kind or 'uint32_t']}"
            self._message(
                b"I",
                _keyed(kind or "uint32_t", name, struct.pack(code, value))
                if isinstance(value, int)
                else _text(key, value),
            )
        for name, number in parameters:
            self.parameter(name, number)
        for number, topic in enumerate(topics):
            multi_id = 0
            self._message(b"A", struct.pack("<BH", multi_id, number) + topic.name.encode("ascii"))
        self.flush()
        self.head_bytes = self.size_bytes
        """Size of the file before the first sample [bytes]."""

    def sample(self, number: int, time_us: int, values: Values) -> None:
        """Add a sample of topic `number` at simulated `time_us` [µs], all its values in order."""
        self.samples(number, self._topics[number].row(time_us, values))

    def samples(self, number: int, rows: NDArray[Any]) -> None:
        """Add messages (n,) of topic `number`, from `Topic.rows`."""
        if len(rows):
            rows["_id"] = number
            self._now_us = rows["timestamp"][-1].item()
            self.add(self._now_us, rows.tobytes())

    def text(self, time_us: int, severity: int, text: str) -> None:
        """Add a text at simulated `time_us` [µs], with severity 0 (emergency) to 7 (debug)."""
        self._now_us = time_us
        head = struct.pack("<BQ", ord("0") + severity, time_us)
        self._message(b"L", head + text.encode("utf-8", errors="replace"))

    def parameter(self, name: str, value: int | float) -> None:
        """Add the value of a parameter, valid from now on."""
        kind, code = ("int32_t", "<i") if isinstance(value, int) else ("float", "<f")
        self._message(b"P", _keyed(kind, name, struct.pack(code, value)))

    def _message(self, kind: bytes, content: bytes) -> None:
        self.add(self._now_us, _HEAD.pack(len(content), ord(kind)), content)


def _text(key: str, value: str) -> bytes:
    data = value.encode("utf-8")
    return _keyed(f"char[{len(data)}]", key, data)


def _keyed(kind: str, key: str, data: bytes) -> bytes:
    described = f"{kind} {key}".encode("ascii")
    return bytes([len(described)]) + described + data
