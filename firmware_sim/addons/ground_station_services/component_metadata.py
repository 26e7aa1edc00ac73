"""Component metadata: files that describe parameters and events to ground stations.

COMPONENT_METADATA (and the older COMPONENT_INFORMATION) contain the URI of the general file. This
file lists the files with parameters and event texts. Ground stations read them over MAVLink FTP.
Source of the formats: https://mavlink.io/en/services/component_information.html,
`general.schema.json`, `parameter.schema.json`.
"""

from __future__ import annotations

import functools
import json
import lzma
import math
import shutil
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

from airl_mav.core.addons import entries, load
from airl_mav.profiles.px4_release import ParameterSpec, PX4ReleaseName, px4_release
from firmware_sim.addons.ground_station_services.files import Storage
from firmware_sim.autopilot import autopilot_state, flight_modes, prearm
from firmware_sim.autopilot.events import flight_events, health_report
from firmware_sim.autopilot.events.definition import (
    ENUMERATIONS,
    Definition,
    Enumeration,
    ModeGroup,
    sub_id,
    words,
)
from firmware_sim.mavlink.codec import crc32part, dialect
from firmware_sim.mavlink.services import Action, Context, VehicleCommand
from firmware_sim.mavlink.streams.units import boot_ms

_MIB = 1024.0 * 1024.0
_FOLDER = "etc/extras"
_GENERAL, _PARAMETERS = "component_general.json.xz", "parameters.json.xz"
_EVENTS = "all_events.json.xz"


@functools.cache
def files(release: PX4ReleaseName) -> dict[str, bytes]:
    """Return the files of a PX4 release by name. Created on first use."""
    # The general file contains the checksums of the others, so it comes last.
    listed = [_parameter_described(spec) for spec in px4_release(release).specs]
    parameters = _compressed({"version": 1, "parameters": listed})
    events = _compressed(_event_document(release))
    entries = [
        {"type": kind, "uri": f"mftp://{_FOLDER}/{name}", "fileCrc": crc32part(data)}
        for kind, name, data in (
            (dialect.COMP_METADATA_TYPE_PARAMETER, _PARAMETERS, parameters),
            (dialect.COMP_METADATA_TYPE_EVENTS, _EVENTS, events),
        )
    ]
    general = _compressed({"version": 1, "metadataTypes": entries})
    return {_GENERAL: general, _PARAMETERS: parameters, _EVENTS: events}


def provide(storage: Storage, release: PX4ReleaseName) -> None:
    """Write the files of a PX4 release to a vehicle's storage if they are missing."""
    folder = storage.folder / _FOLDER
    if folder.is_dir():
        return
    folder.mkdir(parents=True)
    for name, data in files(release).items():
        (folder / name).write_bytes(data)


def request_metadata(_command: VehicleCommand, context: Context) -> autopilot_state.Result:
    """Send COMPONENT_METADATA."""
    context.link.send(
        dialect.MAVLink_component_metadata_message(
            boot_ms(context.now_us), _checksum(context), _uri()
        )
    )
    return autopilot_state.Result.ACCEPTED


def request_information(_command: VehicleCommand, context: Context) -> autopilot_state.Result:
    """Send COMPONENT_INFORMATION, the predecessor of COMPONENT_METADATA."""
    no_crc, no_uri = 0, b""
    context.link.send(
        dialect.MAVLink_component_information_message(
            boot_ms(context.now_us), _checksum(context), _uri(), no_crc, no_uri
        )
    )
    return autopilot_state.Result.ACCEPTED


def _request_storage(command: VehicleCommand, context: Context) -> autopilot_state.Result:
    """Handle parameter 2: storage number; 0 = all. The only storage has number 1."""
    number, count, empty = 1, 1, b""
    if command.integer(2) not in (None, 0, number):
        return autopilot_state.Result.DENIED
    disk = shutil.disk_usage(context.vehicle_state(Storage).folder)
    # STORAGE_INFORMATION has mebibytes.
    sizes = (size / _MIB for size in (disk.total, disk.used, disk.free))
    no_speed = 0.0
    context.link.send(
        dialect.MAVLink_storage_information_message(
            *(boot_ms(context.now_us), number, count, dialect.STORAGE_STATUS_READY),
            *(*sizes, no_speed, no_speed, dialect.STORAGE_TYPE_UNKNOWN, empty),
        )
    )
    return autopilot_state.Result.ACCEPTED


def _checksum(context: Context) -> int:
    return crc32part(files(context.port.parameters.release.name)[_GENERAL])


def _uri() -> bytes:
    return f"mftp://{_FOLDER}/{_GENERAL}".encode("ascii")


def _compressed(document: dict[str, Any]) -> bytes:
    data = json.dumps(document, separators=(",", ":"), ensure_ascii=False).encode()
    # Small decoders in ground stations support only this check.
    return lzma.compress(data, format=lzma.FORMAT_XZ, check=lzma.CHECK_CRC32)


def _parameter_described(spec: ParameterSpec) -> dict[str, Any]:
    # PX4 has two parameter types: INT32 and FLOAT.
    whole = isinstance(spec.default, int)
    kind = int if whole else float
    described: dict[str, Any] = {
        "name": spec.name,
        "type": "Int32" if whole else "Float",
        "default": spec.default,
        "group": spec.name.split("_", 1)[0],
        "shortDesc": spec.meaning or "Has no effect on the simulated vehicle",
    }
    if spec.unit:
        described["units"] = spec.unit
    # An infinite limit is no limit: the schema expects the key to be absent.
    described |= {
        key: kind(limit)
        for key, limit in (("min", spec.low), ("max", spec.high))
        if math.isfinite(limit)
    }
    return described


# --- event texts (https://github.com/mavlink/libevents, `validation/schema.json`)


def all_definitions() -> Iterator[Definition]:
    """Yield the events of all releases that this vehicle can send."""
    added = map(load, entries("firmware_sim", "EVENTS").values())
    for module in (flight_events, health_report, *added):
        for value in vars(module).values():
            if isinstance(value, Definition):
                yield value
    for check in prearm.CHECKS:
        yield check.event


def definitions(release: PX4ReleaseName) -> Iterator[Definition]:
    """Yield the events that this vehicle can send as a PX4 release."""
    found = px4_release(release)
    for event in all_definitions():
        if event.name not in found.unknown_events:
            yield event.of_release(found.events.get(event.name, {}))


def _event_document(release: PX4ReleaseName) -> dict[str, Any]:
    """Return the content of the file with the event texts."""
    groups: dict[str, dict[str, Any]] = {}
    # Event keys are the sub ids within the component's namespace.
    for definition in definitions(release):
        group = groups.setdefault(definition.group, {"events": {}})
        group["events"][str(sub_id(definition.name))] = _event_described(definition)
    component = {
        "namespace": "px4",
        "enums": {name: _enumeration(listed) for name, listed in ENUMERATIONS.items()},
        "event_groups": groups,
        "navigation_mode_groups": {"groups": _modes_of_groups()},
        "supported_protocols": ["health_and_arming_check"],
    }
    return {"version": 2, "components": {"1": component}}


def _event_described(definition: Definition) -> dict[str, Any]:
    described: dict[str, Any] = {"name": definition.name, "message": definition.message}
    if definition.kind:
        described["type"] = definition.kind
    if definition.description:
        described["description"] = definition.description
    if definition.arguments:
        described["arguments"] = [
            {"type": argument.kind, "name": argument.name} for argument in definition.arguments
        ]
    return described


def _enumeration(listed: Enumeration) -> dict[str, Any]:
    described: dict[str, Any] = {"type": listed.base, "description": listed.meaning}
    if listed.bitfield:
        described["is_bitfield"] = True
    described["entries"] = {
        str(member.value): {"name": (member.name or "").lower(), "description": words(member)}
        for member in listed.members
    }
    return described


def _modes_of_groups() -> dict[str, list[int]]:
    """Return the custom modes by bit number of the mode groups in checks."""
    groups = {group.value for group in ModeGroup}
    # A mode can have several bits in the checks; its lowest bit names the group.
    lowest = {mode: mode.spec.state_bits & -mode.spec.state_bits for mode in flight_modes.Mode}
    return {
        str(bit.bit_length() - 1): [mode.spec.custom_mode]
        for mode, bit in lowest.items()
        if bit in groups
    }


def _first_as_second(command: VehicleCommand) -> VehicleCommand:
    first = command.params[0]
    return replace(command, params=(first, first, *command.params[2:]))


REQUESTS: dict[int, Action] = {
    dialect.MAVLINK_MSG_ID_COMPONENT_METADATA: request_metadata,
    dialect.MAVLINK_MSG_ID_COMPONENT_INFORMATION: request_information,
    dialect.MAVLINK_MSG_ID_STORAGE_INFORMATION: _request_storage,
}

ACTIONS: dict[int, Action] = {
    dialect.MAV_CMD_REQUEST_STORAGE_INFORMATION: (
        lambda command, context: _request_storage(_first_as_second(command), context)
    ),
}
