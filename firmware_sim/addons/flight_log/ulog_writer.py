"""ULog, PX4's log format: topic definitions and a streaming writer.

Format: https://docs.px4.io/main/en/dev_log/ulog_file_format.html, version 1. Little endian; every
message consists of content length, type and content.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from airl_mav.core.files import LogFile

Values = tuple[float | int | bool, ...]

_GREATEST_SINGLE = struct.unpack("<f", b"\xff\xff\x7f\x7f")[0]

_MAGIC = b"\x55\x4c\x6f\x67\x01\x12\x35"
_VERSION = 1
_HEAD = struct.Struct("<HB")
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

    @cached_property
    def definition(self) -> bytes:
        """Content of the format message."""
        return f"{self.name}:{';'.join(('uint64_t timestamp', *self.fields))};".encode("ascii")

    @cached_property
    def sample(self) -> struct.Struct:
        """Layout of one sample: topic number, timestamp and fields."""
        return struct.Struct("<HQ" + "".join(_code(field.split()[0]) for field in self.fields))


def _code(kind: str) -> str:
    name, _, count = kind.rstrip("]").partition("[")
    return f"{count}{_CODES[name]}"


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

        The index of a topic is the number for `sample`. Info has ULog keys, numbers as uint32_t.
        An int parameter is written as int32_t.
        """
        super().__init__(path, on_lost)
        topics = tuple(topics)
        self._samples = [topic.sample for topic in topics]
        self._now_us = start_us
        self.add(start_us, _MAGIC, struct.pack("<BQ", _VERSION, start_us))
        self._message(b"B", bytes(_FLAG_BYTES))
        for topic in topics:
            self._message(b"F", topic.definition)
        for key, value in info:
            self._message(
                b"I",
                _text(key, value)
                if isinstance(value, str)
                else _keyed("uint32_t", key, struct.pack("<I", value)),
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
        """Add a sample of topic `number` at simulated `time_us` [µs]; check the fields.

        Values beyond single precision become infinite, as on real hardware.
        """
        layout = self._samples[number]
        self._now_us = time_us
        head = _HEAD.pack(layout.size, ord("D"))
        try:
            data = layout.pack(number, time_us, *values)
        except OverflowError:
            data = layout.pack(number, time_us, *map(_single, values))
        self.add(time_us, head, data)

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


def _single(value: Any) -> Any:
    """Return a float beyond single precision as infinity; other values unchanged."""
    if not isinstance(value, float) or abs(value) <= _GREATEST_SINGLE:
        return value
    return math.copysign(math.inf, value)
