"""Client that reads and sets parameters of external firmware over MAVLink."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterable, Mapping

from firmware_sim.mavlink.codec import WireMessage, dialect, payload

BURST = 10
"""Maximum number of requests sent at once, as the link may be slow."""

Value = int | float

_INTEGERS = {
    dialect.MAV_PARAM_TYPE_INT8: "<b3x",
    dialect.MAV_PARAM_TYPE_UINT8: "<B3x",
    dialect.MAV_PARAM_TYPE_INT16: "<h2x",
    dialect.MAV_PARAM_TYPE_UINT16: "<H2x",
    dialect.MAV_PARAM_TYPE_INT32: "<i",
    dialect.MAV_PARAM_TYPE_UINT32: "<I",
}
"""Struct formats of integers in the value field (bytewise encoding)."""

_FLOAT = struct.Struct("<f")
_VALUE_BYTES = 4


class ParameterClient:
    """Known parameters of a vehicle. The caller repeats requests."""

    def __init__(self, send: Callable[[WireMessage], None]) -> None:
        """Set the function that sends a message."""
        self._send = send
        self._target: tuple[int, int] | None = None
        self._bytewise = True
        self._values: dict[str, Value] = {}
        self._kinds: dict[str, int] = {}

    values = property(lambda self: self._values)
    """Values received so far, by name."""

    def address(self, system: int, component: int, autopilot: int) -> None:
        """Set the target. PX4 encodes integers bytewise, ArduPilot casts them to a float."""
        self._target = system, component
        self._bytewise = autopilot != dialect.MAV_AUTOPILOT_ARDUPILOTMEGA

    def take(self, message: WireMessage) -> None:
        """Store the value of a PARAM_VALUE message."""
        name, kind = str(message.param_id), int(message.param_type)
        self._kinds[name] = kind
        if kind not in _INTEGERS:
            self._values[name] = float(message.param_value)
        elif self._bytewise:
            raw = payload(message).ljust(_VALUE_BYTES, b"\0")[:_VALUE_BYTES]
            (self._values[name],) = struct.unpack(_INTEGERS[kind], raw)
        else:
            self._values[name] = int(message.param_value)

    def ask(self, names: Iterable[str]) -> list[str]:
        """Request up to `BURST` unknown parameters; return the names of all unknown ones."""
        missing = [name for name in names if name not in self._values]
        if self._target is not None:
            for name in missing[:BURST]:
                self._send(
                    dialect.MAVLink_param_request_read_message(
                        *self._target, name.encode("ascii"), -1
                    )
                )
        return missing

    def set(self, wanted: Mapping[str, Value]) -> list[str]:
        """Set differing parameters and return their names; known types determine the encoding."""
        differing = [name for name in wanted if not same(self._values[name], wanted[name])]
        if self._target is not None:
            for name in differing[:BURST]:
                kind = self._kinds[name]
                self._send(
                    dialect.MAVLink_param_set_message(
                        *self._target, name.encode("ascii"), self._encoded(kind, wanted[name]), kind
                    )
                )
        return differing

    def _encoded(self, kind: int, value: Value) -> float:
        if self._bytewise and kind in _INTEGERS:
            (number,) = _FLOAT.unpack(struct.pack(_INTEGERS[kind], int(value)))
            return float(number)
        return float(value)


def same(held: Value, wanted: Value) -> bool:
    """Return True if a parameter has a value, to the precision of a 32-bit float."""
    if isinstance(held, int):
        return held == wanted
    (rounded,) = _FLOAT.unpack(_FLOAT.pack(wanted))
    return bool(abs(held - rounded) <= 1e-6 * max(1.0, abs(rounded)))
