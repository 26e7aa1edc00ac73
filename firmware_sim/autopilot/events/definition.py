"""Event definitions with texts, and events in wire format.

Source: https://mavlink.io/en/services/events.html, and PX4 1.16,
platforms/common/include/px4_platform_common/events.h.
"""

from __future__ import annotations

import math
import struct
from enum import IntEnum
from functools import partial
from typing import NamedTuple

from firmware_sim.autopilot.events.enumerations import ENUMERATIONS

_AUTOPILOT = 1
"""Component id in the most significant byte of an event's id."""
_FNV_BASIS, _FNV_PRIME = 0x811C9DC5, 0x01000193
"""Constants of the 32-bit FNV-1a hash (http://www.isthe.com/chongo/tech/comp/fnv/)."""

_FLOAT_MAX = struct.unpack("<f", b"\xff\xff\x7f\x7f")[0]

FORMATS = {
    "uint8_t": "B",
    "int8_t": "b",
    "uint16_t": "H",
    "int16_t": "h",
    "uint32_t": "I",
    "int32_t": "i",
    "uint64_t": "Q",
    "int64_t": "q",
    "float": "f",
}
"""Argument types and their `struct` formats."""


class Level(IntEnum):
    """Severity of an event. PROTOCOL events are for internal use of ground stations."""

    EMERGENCY = 0
    ALERT = 1
    CRITICAL = 2
    ERROR = 3
    WARNING = 4
    NOTICE = 5
    INFO = 6
    DEBUG = 7
    PROTOCOL = 8
    DISABLED = 9


class Argument(NamedTuple):
    """Argument of an event definition."""

    kind: str
    """Key of `FORMATS` or `ENUMERATIONS`."""
    name: str


class MavlinkEvent(NamedTuple):
    """Event instance in wire format."""

    number: int
    """MAVLink event id: component and hash of the name."""
    levels: int
    """Internal level << 4 | external level."""
    arguments: bytes


class Definition(NamedTuple):
    """Definition of an event type."""

    name: str
    message: str
    """`{1}` is the first argument; `{1:.1m}` has one decimal and a unit."""
    arguments: tuple[Argument, ...] = ()
    level: Level = Level.INFO
    internal: Level | None = None
    """Level in PX4's log; None = same as `level`."""
    description: str = ""
    group: str = "default"
    kind: str = ""
    """Handling by ground stations beyond display; "" = none."""

    @property
    def number(self) -> int:
        """MAVLink id of the event."""
        return _AUTOPILOT << 24 | sub_id(self.name)

    def event(self, *values: float, level: Level | None = None) -> MavlinkEvent:
        """Return an event of this type; `level` overrides its levels.

        Values outside the range of an argument are clipped, so that a home 3e38 m high causes no
        error. Raises struct.error if the number of values differs from the number of arguments.
        """
        external = self.level if level is None else level
        internal = external if self.internal is None or level is not None else self.internal
        formats = [_format(argument.kind) for argument in self.arguments]
        fitted = [_fitted(value, of) for value, of in zip(values, formats, strict=False)]
        packed = struct.pack("<" + "".join(formats), *fitted, *values[len(formats) :])
        return MavlinkEvent(self.number, internal << 4 | external, packed)


def sub_id(name: str) -> int:
    """Return the name-dependent part of an event id: 24 bits of FNV-1a."""
    value = _FNV_BASIS
    for byte in name.encode("ascii"):
        value = (value ^ byte) * _FNV_PRIME & 0xFFFFFFFF
    return value & 0xFFFFFF


def arguments(listed: str) -> tuple[Argument, ...]:
    """Return the arguments of a "type name, type name" list."""
    return tuple(Argument(*text.split()) for text in listed.split(", ") if text)


def define(
    name: str,
    message: str,
    listed: str = "",
    level: Level = Level.INFO,
    internal: Level | None = None,
    description: str = "",
    kind: str = "",
) -> Definition:
    """Return a definition with the arguments of a "type name, type name" list."""
    return Definition(
        name, message, arguments(listed), level, internal, description=description, kind=kind
    )


wrong = partial(define, level=Level.ERROR)
critical = partial(define, level=Level.CRITICAL, internal=Level.INFO)
error = partial(define, level=Level.ERROR, internal=Level.INFO)
warning = partial(define, level=Level.WARNING, internal=Level.INFO)


def _fitted(value: float, of: str) -> float:
    """Return a value clipped to a field of a `struct` format; NaN becomes 0 in integer fields."""
    if of == "f":
        # As a cast in C: infinite beyond its range.
        return math.copysign(math.inf, value) if abs(value) > _FLOAT_MAX else value
    bits = 8 * struct.calcsize(of)
    low, high = (0, 2**bits - 1) if of.isupper() else (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1)
    return 0 if value != value else int(min(high, max(low, value)))


def _format(kind: str) -> str:
    return FORMATS[ENUMERATIONS[kind].base if kind in ENUMERATIONS else kind]
