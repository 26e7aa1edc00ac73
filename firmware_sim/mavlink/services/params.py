"""Parameter protocol with PX4's bytewise encoding: an INT32 is sent as the bytes of a float."""

from __future__ import annotations

import functools
import math
import struct

from firmware_sim.autopilot.autopilot_state import Arming, Result
from firmware_sim.autopilot.parameter_store import Parameters, ParameterValue
from firmware_sim.mavlink import services
from firmware_sim.mavlink.codec import WireMessage, crc32part, dialect, param_value, payload

HASH_NAME = "_HASH_CHECK"
"""Name of a pseudo parameter: checksum with which ground stations validate cached values."""

PARAMETERS_PER_TICK = 3
"""Parameters of a full list sent per tick; a list has hundreds."""

_NO_INDEX = 65_535
_ERROR_TYPE_MISMATCH = 7
"""MAV_PARAM_ERROR_TYPE_MISMATCH, which pymavlink's dialect lacks."""


def send_pending(context: services.Context) -> None:
    """Send the next parameters of a running list; call once per tick."""
    if context.next_parameter is None:
        return
    store = context.port.parameters
    for _ in range(PARAMETERS_PER_TICK):
        # Index -1 is the hash: with it a ground station can skip the list.
        if context.next_parameter < 0:
            context.link.send_payload(*_hash_message(store))
        else:
            parameter = store.by_index(context.next_parameter)
            if parameter is None:
                context.next_parameter = None
                return
            context.link.send_payload(*_value_message(parameter, len(store)))
        context.next_parameter += 1


def handle_list(_message: WireMessage, context: services.Context) -> bool:
    """Start sending all parameters."""
    # As in PX4: a client that repeats the request does not need the hash.
    context.next_parameter = -1 if context.next_parameter is None else 0
    return True


def handle_read(message: WireMessage, context: services.Context) -> bool:
    """Send one parameter, by index or by name."""
    store = context.port.parameters
    index: int = message.param_index
    # The hash has no index.
    if index < 0 and message.param_id == HASH_NAME:
        context.link.send_payload(*_hash_message(store))
        return True
    parameter = store.by_index(index) if index >= 0 else store.by_name(message.param_id)
    if parameter is None:
        _send_error(message, index, dialect.MAV_PARAM_ERROR_DOES_NOT_EXIST, context)
    else:
        context.link.send_payload(*_value_message(parameter, len(store)))
    return True


def handle_set(message: WireMessage, context: services.Context) -> bool:
    """Set a parameter, and send its new value on all links."""
    if message.param_id == HASH_NAME:
        context.next_parameter = None  # the client's cached values are valid: stop the list
        return True
    store = context.port.parameters
    present = store.by_name(message.param_id)
    if present is None:
        error = dialect.MAV_PARAM_ERROR_DOES_NOT_EXIST
    # PX4 rejects a value of the wrong type: its bytes would be misread.
    elif message.param_type != _kind(present.value):
        error = _ERROR_TYPE_MISMATCH
    elif not math.isfinite(value := _received_value(message)):
        error = dialect.MAV_PARAM_ERROR_VALUE_OUT_OF_RANGE
    elif store_parameter(present.name, value, context) is None:
        error = dialect.MAV_PARAM_ERROR_DOES_NOT_EXIST
    else:
        return True
    _send_error(message, -1, error, context)
    return True


def store_parameter(
    name: str, value: int | float, context: services.Context
) -> ParameterValue | None:
    """Store a value; all clients receive it, as in PX4. Returns None for an unknown name."""
    store = context.port.parameters
    stored = store.set(name, value)
    if stored is not None:
        context.broadcast(*_value_message(stored, len(store)))
    return stored


def _send_error(message: WireMessage, index: int, error: int, context: services.Context) -> None:
    context.link.send(
        dialect.MAVLink_param_error_message(
            *services.sender(message),
            message.param_id.encode("ascii", errors="replace"),
            index,
            error,
        )
    )


def _kind(value: int | float) -> int:
    whole = isinstance(value, int)
    return int(dialect.MAV_PARAM_TYPE_INT32 if whole else dialect.MAV_PARAM_TYPE_REAL32)


def _encoded(value: int | float) -> bytes:
    """Return a stored value's four bytes, little endian."""
    return struct.pack("<i" if isinstance(value, int) else "<f", value)


def _received_value(message: WireMessage) -> int | float:
    """Return the value of a PARAM_SET from its bytes (the start of the payload)."""
    shape = "<i" if message.param_type == dialect.MAV_PARAM_TYPE_INT32 else "<f"
    value: int | float
    (value,) = struct.unpack(shape, payload(message)[:4].ljust(4, b"\0"))
    return value


def _value_message(parameter: ParameterValue, count: int) -> tuple[str, bytes]:
    """Return name and payload of a PARAM_VALUE message."""
    value = parameter.value
    body = param_value(parameter.name, _encoded(value), _kind(value), count, parameter.index)
    return "PARAM_VALUE", body


def _hash_message(store: Parameters) -> tuple[str, bytes]:
    digest = struct.pack("<I", _hash_of(store, store.revision))
    kind = dialect.MAV_PARAM_TYPE_UINT32
    return "PARAM_VALUE", param_value(HASH_NAME, digest, kind, len(store), _NO_INDEX)


@functools.lru_cache(maxsize=1)
def _hash_of(store: Parameters, _revision: int) -> int:
    """Return PX4's param_hash_check(): CRC-32 without inversions over all names and values.

    Cached for all new clients, because the computation takes most of a tick.
    """
    parameters = filter(None, map(store.by_index, range(len(store))))
    return crc32part(b"".join(p.name.encode("ascii") + _encoded(p.value) for p in parameters))


# --- PREFLIGHT_STORAGE

_LOAD, _SAVE, _RESET, _RESET_SENSORS, _FACTORY_RESET = range(5)


def _store(command: services.VehicleCommand, context: services.Context) -> Result | None:
    """Handle parameter 1: action. PX4 does not acknowledge unknown actions."""
    if context.port.state().status.arming is Arming.ARMED:
        return Result.TEMPORARILY_REJECTED
    parameters = context.port.parameters
    action = command.integer(1)
    # Both resets restore the defaults.
    if action in (_RESET, _FACTORY_RESET):
        parameters.reset()
    elif action == _LOAD:
        return Result.ACCEPTED if parameters.load() else Result.FAILED
    elif action == _SAVE:
        return Result.ACCEPTED if parameters.save() else Result.FAILED
    elif action != _RESET_SENSORS:  # sensors have no calibration to reset
        return None
    return Result.ACCEPTED


ACTIONS: dict[int, services.Action] = {dialect.MAV_CMD_PREFLIGHT_STORAGE: _store}

HANDLERS: services.Handlers = {
    "PARAM_REQUEST_LIST": (services.for_vehicle, handle_list),
    "PARAM_REQUEST_READ": (services.for_vehicle, handle_read),
    "PARAM_SET": (services.for_vehicle, handle_set),
}
