"""Events: a definition with words, and one that happened, as it is sent.

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
"""Component id in the uppermost byte of an event's id."""
_FNV_BASIS, _FNV_PRIME = 0x811C9DC5, 0x01000193
"""Of the hash FNV-1a with 32 bits (http://www.isthe.com/chongo/tech/comp/fnv/)."""

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
"""Types of arguments, as `struct` has them."""


class Level(IntEnum):
    """Urgency of an event. PROTOCOL is for ground stations' own use."""

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
    """One argument of a definition."""

    kind: str
    """One of `FORMATS`, or an enumeration of `ENUMERATIONS`."""
    name: str


class Event(NamedTuple):
    """An event that happened."""

    number: int
    """MAVLink's id of the event: component and hash of its name."""
    levels: int
    """Internal level << 4 | external level."""
    arguments: bytes


class Definition(NamedTuple):
    """A kind of event."""

    name: str
    message: str
    """`{1}` is the first argument; `{1:.1m}` has one decimal and a unit."""
    arguments: tuple[Argument, ...] = ()
    level: Level = Level.INFO
    internal: Level | None = None
    """Level in PX4's own log; None = as `level`."""
    description: str = ""
    group: str = "default"
    kind: str = ""
    """What ground stations do with it beyond telling it; "" = nothing."""

    @property
    def number(self) -> int:
        """MAVLink's id of the event."""
        return _AUTOPILOT << 24 | sub_id(self.name)

    def event(self, *values: float, level: Level | None = None) -> Event:
        """Return an event of this kind; `level` overrides its levels.

        A value that does not fit its argument becomes the nearest that does: what a vehicle says
        may not depend on whether its home is 3e38 m high. Raises struct.error for another number of
        values than there are arguments.
        """
        external = self.level if level is None else level
        internal = external if self.internal is None or level is not None else self.internal
        formats = [_format(argument.kind) for argument in self.arguments]
        fitted = [_fitted(value, of) for value, of in zip(values, formats, strict=False)]
        packed = struct.pack("<" + "".join(formats), *fitted, *values[len(formats) :])
        return Event(self.number, internal << 4 | external, packed)


def sub_id(name: str) -> int:
    """Return the part of an event's id that its name decides: 24 bits of FNV-1a."""
    value = _FNV_BASIS
    for byte in name.encode("ascii"):
        value = (value ^ byte) * _FNV_PRIME & 0xFFFFFFFF
    return value & 0xFFFFFF


def arguments(listed: str) -> tuple[Argument, ...]:
    """Return the arguments of "type name, type name"."""
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
    """Return a definition with arguments of "type name, type name"."""
    return Definition(
        name, message, arguments(listed), level, internal, description=description, kind=kind
    )


wrong = partial(define, level=Level.ERROR)
critical = partial(define, level=Level.CRITICAL, internal=Level.INFO)
error = partial(define, level=Level.ERROR, internal=Level.INFO)
warning = partial(define, level=Level.WARNING, internal=Level.INFO)


def _fitted(value: float, of: str) -> float:
    """Return the nearest value that a field of a `struct` format holds; NaN is 0 in whole ones."""
    if of == "f":
        # As a cast in C: beyond its range it is infinite.
        return math.copysign(math.inf, value) if abs(value) > _FLOAT_MAX else value
    bits = 8 * struct.calcsize(of)
    low, high = (0, 2**bits - 1) if of.isupper() else (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1)
    return 0 if value != value else int(min(high, max(low, value)))


def _format(kind: str) -> str:
    return FORMATS[ENUMERATIONS[kind].base if kind in ENUMERATIONS else kind]
