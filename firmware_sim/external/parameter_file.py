"""Parameters of external firmware as files for the tools of its users."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from firmware_sim.external.parameter_client import Value

_INT32, _REAL32 = 6, 9
"""MAV_PARAM_TYPE, as QGroundControl writes it."""


def ardupilot_file(settings: Mapping[str, Value]) -> str:
    """Return a file of ArduPilot's: `--defaults` of its SITL, Mission Planner, MAVProxy."""
    return "".join(f"{name} {value:g}\n" for name, value in settings.items())


def qgroundcontrol_file(settings: Mapping[str, Value]) -> str:
    """Return a file for QGroundControl (Vehicle Setup > Parameters > Tools), format "Parameters".

    Lines hold vehicle id, component id, name, value and type, between tabs.
    """
    head = "# Vehicle-Id Component-Id Name Value Type\n"
    return head + "".join(
        f"1\t1\t{name}\t{value}\t{_INT32}\n"
        if isinstance(value, int)
        else f"1\t1\t{name}\t{value:.9g}\t{_REAL32}\n"
        for name, value in settings.items()
    )
