"""Flight times, return time, protocol version, and PX4's modes (names and numbers).

Source: PX4 src/lib/modes, src/modules/mavlink/streams/{AVAILABLE_MODES,CURRENT_MODE}.hpp, and the
messages of a running PX4 1.16.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

from airl_mav.core.frames import geodetic_to_local
from firmware_sim.autopilot.autopilot_state import AutopilotState, Landed, Mode
from firmware_sim.autopilot.commander import custom_mode
from firmware_sim.autopilot.navigation.return_path import return_time_s
from firmware_sim.mavlink.codec import Values, dialect
from firmware_sim.mavlink.streams.units import boot_ms

_VERSION, _LEAST_VERSION, _GREATEST_VERSION = 200, 100, 200
"""Sent, minimum and maximum version: MAVLink 2.0 is sent, 1.0 is accepted, as in PX4."""

_NO_HASH = (0,) * 8


def flight_information(state: AutopilotState) -> Values:
    """Return the times of arming and takeoff [µs since boot]; 0 while disarmed."""
    flight_uuid = landing_time = 0
    armed, took_off = state.armed_us, state.takeoff_us
    return boot_ms(state.time_us), armed, took_off, flight_uuid, landing_time


def protocol_version(state: AutopilotState) -> Values:  # noqa: ARG001 - a builder
    """Return the supported MAVLink versions."""
    return _VERSION, _LEAST_VERSION, _GREATEST_VERSION, *_NO_HASH, *_NO_HASH


_UNKNOWN_TIME = -1
"""Value of unknown times: PX4 estimates only the return time."""


def time_estimate_to_target(state: AutopilotState, value: Callable[[str], float]) -> Values | None:
    """Return the duration of a safe return [s]; 0 on the ground, None without home.

    `value` returns the current value of a PX4 parameter by name.
    """
    home, origin = state.home, state.origin
    if home is None or origin is None:
        return None
    took = 0.0
    # On the ground the return takes no time.
    if state.status.landed is not Landed.ON_GROUND:
        target = geodetic_to_local(home, origin).tolist()
        north, east, down = (
            b - a for a, b in zip(target, state.estimate.position.tolist(), strict=True)
        )
        took = return_time_s(value, -down, math.hypot(north, east))
    unknown = (_UNKNOWN_TIME,) * 4
    return int(took) if math.isfinite(took) else _UNKNOWN_TIME, *unknown


class KnownMode(NamedTuple):
    """Flight mode of PX4."""

    main: int
    """Main mode of custom_mode."""
    sub: int
    standard: int = dialect.MAV_STANDARD_MODE_NON_STANDARD
    """Value of MAV_STANDARD_MODE."""
    name: str = ""
    """Name of the mode; empty if the standard mode implies it."""
    properties: int = dialect.MAV_MODE_PROPERTY_ADVANCED
    """Bits of MAV_MODE_PROPERTY."""

    @property
    def custom_mode(self) -> int:
        """Value of PX4's custom_mode."""
        return self.main << 16 | self.sub << 24


KNOWN = (
    KnownMode(1, 0, name="Manual"),
    KnownMode(2, 0, dialect.MAV_STANDARD_MODE_ALTITUDE_HOLD, properties=0),
    KnownMode(3, 0, dialect.MAV_STANDARD_MODE_POSITION_HOLD, properties=0),
    KnownMode(4, 4, dialect.MAV_STANDARD_MODE_MISSION),
    KnownMode(4, 3, name="Hold"),
    KnownMode(4, 5, dialect.MAV_STANDARD_MODE_SAFE_RECOVERY),
    KnownMode(3, 2, name="Position Slow"),
    KnownMode(5, 0, name="Acro"),
    KnownMode(
        10,
        0,
        name="Termination",
        properties=dialect.MAV_MODE_PROPERTY_ADVANCED
        | dialect.MAV_MODE_PROPERTY_NOT_USER_SELECTABLE,
    ),
    KnownMode(6, 0, name="Offboard"),
    KnownMode(7, 0, name="Stabilized"),
    KnownMode(4, 2, dialect.MAV_STANDARD_MODE_TAKEOFF),
    KnownMode(4, 6, dialect.MAV_STANDARD_MODE_LAND),
    KnownMode(4, 8, name="Follow Target"),
    KnownMode(4, 9, name="Precision Landing"),
    KnownMode(3, 1, dialect.MAV_STANDARD_MODE_ORBIT),
)
"""PX4's multicopter modes, in PX4's order (vehicle_status.nav_state)."""

_STANDARD = {known.custom_mode: known.standard for known in KNOWN}


def existing() -> tuple[KnownMode, ...]:
    """Return the modes supported here."""
    ours = {custom_mode(mode) for mode in Mode}
    return tuple(known for known in KNOWN if known.custom_mode in ours)


def available_modes() -> list[tuple[int, int, int, int, int, bytes]]:
    """Return the fields of AVAILABLE_MODES for each supported mode, in order."""
    modes = existing()
    # The count and the number of each mode, starting at 1, in every message.
    return [
        (len(modes), number, known.standard, known.custom_mode, known.properties, name)
        for number, known in enumerate(modes, start=1)
        for name in (known.name.encode("ascii"),)
    ]


def current_mode(state: AutopilotState) -> Values:
    """Return the active mode and the mode requested by the user."""
    status = state.status
    intended = custom_mode(status.intended_mode)
    return _STANDARD.get(intended, 0), custom_mode(status.mode), intended
