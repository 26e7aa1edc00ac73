"""The words of events as a file: what ground stations decode EVENT with.

Source of the format: https://github.com/mavlink/libevents, `validation/schema.json`.
"""

from __future__ import annotations

from collections.abc import Iterator
from types import ModuleType
from typing import Any

from firmware_sim.autopilot.events import (
    check_events,
    command_events,
    flight_events,
    mission_events,
)
from firmware_sim.autopilot.events.check_events import CheckEvent
from firmware_sim.autopilot.events.definition import Definition, sub_id
from firmware_sim.autopilot.events.enumerations import ENUMERATIONS, Enumeration, ModeGroup, words
from firmware_sim.autopilot.mode_numbers import STATE_BITS, custom_mode

_AUTOPILOT = "1"
_NAMESPACE = "px4"


def definitions() -> Iterator[Definition]:
    """Yield every event that this vehicle can send."""
    for module in (flight_events, mission_events, command_events, check_events):
        for value in _values(module):
            if isinstance(value, Definition):
                yield value
            elif isinstance(value, CheckEvent):
                yield value.definition


def document() -> dict[str, Any]:
    """Return the file's content."""
    groups: dict[str, dict[str, Any]] = {}
    for definition in definitions():
        group = groups.setdefault(definition.group, {"events": {}})
        group["events"][str(sub_id(definition.name))] = _described(definition)
    component = {
        "namespace": _NAMESPACE,
        "enums": {name: _enumeration(listed) for name, listed in ENUMERATIONS.items()},
        "event_groups": groups,
        "navigation_mode_groups": {"groups": _modes_of_groups()},
        "supported_protocols": ["health_and_arming_check"],
    }
    return {"version": 2, "components": {_AUTOPILOT: component}}


def _values(module: ModuleType) -> list[object]:
    return [value for name, value in vars(module).items() if not name.startswith("__")]


def _described(definition: Definition) -> dict[str, Any]:
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
        str(member.value): {"name": member.name.lower(), "description": words(member)}
        for member in listed.members
    }
    return described


def _modes_of_groups() -> dict[str, list[int]]:
    """Return the custom modes that each bit of a check stands for."""
    groups = {group.value for group in ModeGroup}
    lowest = {mode: bits & -bits for mode, bits in STATE_BITS.items()}
    return {
        str(bit.bit_length() - 1): [custom_mode(mode)]
        for mode, bit in lowest.items()
        if bit in groups
    }
