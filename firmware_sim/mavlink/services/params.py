"""The parameter protocol with PX4's bytewise encoding: an INT32 travels as the bytes of a float."""

from __future__ import annotations

import math
import struct
import zlib

from firmware_sim.autopilot.port import ParameterStore, ParameterValue
from firmware_sim.mavlink.codec import WireMessage, dialect, param_value, payload
from firmware_sim.mavlink.link import Link
from firmware_sim.mavlink.services.context import Context, Handler, for_vehicle, sender

HASH_NAME = "_HASH_CHECK"
"""Pseudo parameter: a checksum by which a ground station recognises its cached values."""

PARAMETERS_PER_TICK = 3
"""Parameters of a full list that are sent per tick: it has hundreds."""

_NO_INDEX = 65_535
_ALL_ONES = 0xFFFF_FFFF
_ERROR_TYPE_MISMATCH = 7
"""MAV_PARAM_ERROR_TYPE_MISMATCH, newer than pymavlink's dialect."""


class ParameterService:
    """Parameters of the vehicle over one link."""

    def __init__(self) -> None:
        self._next: int | None = None
        """Index that a running list sends next; -1 = the hash; None = no list is running."""
        self.handlers: dict[str, Handler] = {
            "PARAM_REQUEST_LIST": self._handle_list,
            "PARAM_REQUEST_READ": self._handle_read,
            "PARAM_SET": self._handle_set,
        }

    def restart(self) -> None:
        """Cancel a running list: the vehicle was replaced."""
        self._next = None

    def send_pending(self, link: Link, store: ParameterStore) -> None:
        """Send the next few parameters of a running list; call once per tick."""
        if self._next is None:
            return
        for _ in range(PARAMETERS_PER_TICK):
            if self._next < 0:
                link.send(_hash_message(store))
            else:
                parameter = store.by_index(self._next)
                if parameter is None:
                    self._next = None
                    return
                link.send(_value_message(parameter, len(store)))
            self._next += 1

    def _handle_list(self, message: WireMessage, _context: Context) -> bool:
        if not for_vehicle(message):
            return False
        # As PX4: a client that asks again does not need the hash.
        self._next = -1 if self._next is None else 0
        return True

    def _handle_read(self, message: WireMessage, context: Context) -> bool:
        if not for_vehicle(message):
            return False
        store = context.port.parameters
        index: int = message.param_index
        if index < 0 and message.param_id == HASH_NAME:
            context.link.send(_hash_message(store))
            return True
        parameter = store.by_index(index) if index >= 0 else store.by_name(message.param_id)
        if parameter is None:
            _send_error(message, index, dialect.MAV_PARAM_ERROR_DOES_NOT_EXIST, context)
        else:
            context.link.send(_value_message(parameter, len(store)))
        return True

    def _handle_set(self, message: WireMessage, context: Context) -> bool:
        if not for_vehicle(message):
            return False
        if message.param_id == HASH_NAME:
            self._next = None  # "my cached values are good: stop the list"
            return True
        store = context.port.parameters
        present = store.by_name(message.param_id)
        error = _set_error(present, message)
        if present is None or error is not None:
            _send_error(message, -1, error, context)
            return True
        stored = store.set(present.name, _received_value(message))
        if stored is None:
            _send_error(message, -1, dialect.MAV_PARAM_ERROR_DOES_NOT_EXIST, context)
        else:
            context.broadcast(_value_message(stored, len(store)))
        return True


def _set_error(present: ParameterValue | None, message: WireMessage) -> int | None:
    """Return the MAV_PARAM_ERROR of a PARAM_SET, None when it can be done."""
    error: int | None = None
    if present is None:
        error = dialect.MAV_PARAM_ERROR_DOES_NOT_EXIST
    elif message.param_type != _kind(present.value):
        error = _ERROR_TYPE_MISMATCH
    elif not math.isfinite(_received_value(message)):
        error = dialect.MAV_PARAM_ERROR_VALUE_OUT_OF_RANGE
    return error


def _send_error(message: WireMessage, index: int, error: int | None, context: Context) -> None:
    context.link.send(
        dialect.MAVLink_param_error_message(
            *sender(message), message.param_id.encode("ascii", errors="replace"), index, error
        )
    )


def _kind(value: int | float) -> int:
    kind: int = (
        dialect.MAV_PARAM_TYPE_INT32 if isinstance(value, int) else dialect.MAV_PARAM_TYPE_REAL32
    )
    return kind


def _encoded(value: int | float) -> bytes:
    """Return a stored value's four bytes, little endian."""
    return struct.pack("<i" if isinstance(value, int) else "<f", value)


def _received_value(message: WireMessage) -> int | float:
    """Return the value of a PARAM_SET from its bytes (they lead the payload)."""
    raw = payload(message)[:4].ljust(4, b"\0")
    value: int | float
    (value,) = struct.unpack(
        "<i" if message.param_type == dialect.MAV_PARAM_TYPE_INT32 else "<f", raw
    )
    return value


def _value_message(parameter: ParameterValue, count: int) -> WireMessage:
    value = parameter.value
    return param_value(parameter.name, _encoded(value), _kind(value), count, parameter.index)


def _hash_message(store: ParameterStore) -> WireMessage:
    digest = struct.pack("<I", parameter_hash(store))
    return param_value(HASH_NAME, digest, dialect.MAV_PARAM_TYPE_UINT32, len(store), _NO_INDEX)


def parameter_hash(store: ParameterStore) -> int:
    """Return PX4's param_hash_check(): CRC-32 without inversions over all names and values."""
    crc = 0
    for index in range(len(store)):
        parameter = store.by_index(index)
        if parameter is None:
            continue
        data = parameter.name.encode("ascii") + _encoded(parameter.value)
        # zlib inverts before and after; PX4's crc32part() does not.
        crc = zlib.crc32(data, crc ^ _ALL_ONES) ^ _ALL_ONES
    return crc
