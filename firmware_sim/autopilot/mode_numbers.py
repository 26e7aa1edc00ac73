"""PX4's numbers of the flight modes: in custom_mode, in checks and in messages.

Source: PX4 1.16, commander/px4_custom_mode.h, msg/versioned/VehicleStatus.msg and
src/lib/events/enums.json.
"""

from __future__ import annotations

from collections.abc import Mapping

from firmware_sim.autopilot.autopilot_state import Mode
from firmware_sim.autopilot.events.enumerations import NavigationMode

MAIN_POSCTL, MAIN_AUTO, MAIN_ACRO, MAIN_OFFBOARD, MAIN_TERMINATION = 3, 4, 5, 6, 10

MAIN_SUB: Mapping[Mode, tuple[int, int]] = {
    Mode.HOLD: (MAIN_AUTO, 3),
    Mode.TAKEOFF: (MAIN_AUTO, 2),
    Mode.LAND: (MAIN_AUTO, 6),
    Mode.RETURN: (MAIN_AUTO, 5),
    Mode.OFFBOARD: (MAIN_OFFBOARD, 0),
    Mode.POSITION: (MAIN_POSCTL, 0),
    Mode.MISSION: (MAIN_AUTO, 4),
    Mode.ORBIT: (MAIN_POSCTL, 1),
    Mode.FOLLOW: (MAIN_AUTO, 8),
    Mode.MANUAL: (1, 0),
    Mode.ALTITUDE: (2, 0),
    Mode.ACRO: (MAIN_ACRO, 0),
    Mode.STABILIZED: (7, 0),
    Mode.DESCEND: (MAIN_AUTO, 6),  # PX4 reports it as Land
    Mode.TERMINATION: (MAIN_TERMINATION, 0),
    Mode.PRECISION_LAND: (MAIN_AUTO, 9),
}
"""Main and sub mode."""

STATE_BITS: Mapping[Mode, int] = {
    Mode.MANUAL: 1 << 0,
    Mode.ALTITUDE: 1 << 1,
    Mode.POSITION: 1 << 2 | 1 << 6,  # also in its slow variant
    Mode.MISSION: 1 << 3,
    Mode.HOLD: 1 << 4,
    Mode.RETURN: 1 << 5,
    Mode.ACRO: 1 << 10,
    Mode.DESCEND: 1 << 12,
    Mode.TERMINATION: 1 << 13,
    Mode.OFFBOARD: 1 << 14,
    Mode.STABILIZED: 1 << 15,
    Mode.TAKEOFF: 1 << 17 | 1 << 22,  # also a VTOL's, which no multicopter flies
    Mode.LAND: 1 << 18,
    Mode.FOLLOW: 1 << 19,
    Mode.PRECISION_LAND: 1 << 20,
    Mode.ORBIT: 1 << 21,
}
"""A mode's navigation states, each a bit of what a check says of modes."""

_NAMED: Mapping[Mode, NavigationMode] = {
    Mode.MANUAL: NavigationMode.MANUAL,
    Mode.ALTITUDE: NavigationMode.ALTCTL,
    Mode.POSITION: NavigationMode.POSCTL,
    Mode.MISSION: NavigationMode.AUTO_MISSION,
    Mode.HOLD: NavigationMode.AUTO_LOITER,
    Mode.RETURN: NavigationMode.AUTO_RTL,
    Mode.ACRO: NavigationMode.ACRO,
    Mode.OFFBOARD: NavigationMode.OFFBOARD,
    Mode.STABILIZED: NavigationMode.STAB,
    Mode.TAKEOFF: NavigationMode.AUTO_TAKEOFF,
    Mode.LAND: NavigationMode.AUTO_LAND,
    Mode.FOLLOW: NavigationMode.AUTO_FOLLOW_TARGET,
    Mode.PRECISION_LAND: NavigationMode.AUTO_PRECLAND,
    Mode.ORBIT: NavigationMode.ORBIT,
}


def custom_mode(mode: Mode) -> int:
    """Return PX4's custom_mode: main mode << 16 | sub mode << 24."""
    main, sub = MAIN_SUB[mode]
    return main << 16 | sub << 24


def named(mode: Mode) -> NavigationMode:
    """Return the number by which a message names a mode."""
    return _NAMED.get(mode, NavigationMode.UNKNOWN)
