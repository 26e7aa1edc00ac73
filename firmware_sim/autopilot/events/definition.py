"""What an event is: a definition with words, and one that happened, as it goes over the wire.

Source: https://mavlink.io/en/services/events.html, and PX4 1.16,
platforms/common/include/px4_platform_common/events.h.
"""

from __future__ import annotations

import struct
from enum import IntEnum
from typing import NamedTuple

from firmware_sim.autopilot.events.enumerations import ENUMERATIONS

MAX_ARGUMENT_BYTES = 25
"""PX4's limit for the arguments of an event."""

_AUTOPILOT = 1
"""Component id in the uppermost byte of an event's id."""
_FNV_BASIS, _FNV_PRIME = 0x811C9DC5, 0x01000193
"""Of the hash FNV-1a with 32 bits (http://www.isthe.com/chongo/tech/comp/fnv/)."""

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
    """How urgent an event is; nobody is told of PROTOCOL, which is for ground stations' own use."""

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

        Raises:
            struct.error: A value, or the number of values, does not fit the arguments.
        """
        external = self.level if level is None else level
        internal = external if self.internal is None or level is not None else self.internal
        layout = "<" + "".join(_format(argument.kind) for argument in self.arguments)
        return Event(self.number, internal << 4 | external, struct.pack(layout, *values))


def sub_id(name: str) -> int:
    """Return the part of an event's id that its name decides: 24 bits of FNV-1a."""
    value = _FNV_BASIS
    for byte in name.encode("ascii"):
        value = (value ^ byte) * _FNV_PRIME & 0xFFFFFFFF
    return value & 0xFFFFFF


def arguments(*kinds_and_names: str) -> tuple[Argument, ...]:
    """Return arguments of "type name" each."""
    return tuple(Argument(*text.split()) for text in kinds_and_names)


def _format(kind: str) -> str:
    return FORMATS[ENUMERATIONS[kind].base if kind in ENUMERATIONS else kind]
