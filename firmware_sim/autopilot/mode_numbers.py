"""PX4's mode numbers in custom_mode, checks and messages.

Source: PX4 1.16, commander/px4_custom_mode.h, msg/versioned/VehicleStatus.msg and
src/lib/events/enums.json.
"""

from __future__ import annotations

from collections.abc import Mapping

from firmware_sim.autopilot.autopilot_state import Mode
from firmware_sim.autopilot.events.enumerations import NavigationMode

MAIN_POSCTL, MAIN_AUTO, MAIN_ACRO, MAIN_OFFBOARD, MAIN_TERMINATION = 3, 4, 5, 6, 10

_N = NavigationMode

_NUMBERS: Mapping[Mode, tuple[int, int, int, NavigationMode]] = {
    Mode.HOLD: (MAIN_AUTO, 3, 4, _N.AUTO_LOITER),
    Mode.TAKEOFF: (MAIN_AUTO, 2, 17, _N.AUTO_TAKEOFF),
    Mode.LAND: (MAIN_AUTO, 6, 18, _N.AUTO_LAND),
    Mode.RETURN: (MAIN_AUTO, 5, 5, _N.AUTO_RTL),
    Mode.OFFBOARD: (MAIN_OFFBOARD, 0, 14, _N.OFFBOARD),
    Mode.POSITION: (MAIN_POSCTL, 0, 2, _N.POSCTL),
    Mode.MISSION: (MAIN_AUTO, 4, 3, _N.AUTO_MISSION),
    Mode.ORBIT: (MAIN_POSCTL, 1, 21, _N.ORBIT),
    Mode.FOLLOW: (MAIN_AUTO, 8, 19, _N.AUTO_FOLLOW_TARGET),
    Mode.MANUAL: (1, 0, 0, _N.MANUAL),
    Mode.ALTITUDE: (2, 0, 1, _N.ALTCTL),
    Mode.ACRO: (MAIN_ACRO, 0, 10, _N.ACRO),
    Mode.STABILIZED: (7, 0, 15, _N.STAB),
    Mode.DESCEND: (MAIN_AUTO, 6, 12, _N.UNKNOWN),  # PX4 reports it as Land
    Mode.TERMINATION: (MAIN_TERMINATION, 0, 13, _N.UNKNOWN),
    Mode.PRECISION_LAND: (MAIN_AUTO, 9, 20, _N.AUTO_PRECLAND),
}
"""Main mode, sub mode, navigation state (VehicleStatus.nav_state), number in messages."""

MAIN_SUB = {mode: (main, sub) for mode, (main, sub, _, _) in _NUMBERS.items()}
"""Main and sub mode."""

NAVIGATION_STATES = {mode: state for mode, (_, _, state, _) in _NUMBERS.items()}

_MORE_STATES = {
    Mode.POSITION: 1 << 6,  # its slow variant
    Mode.TAKEOFF: 1 << 22,  # a VTOL's, which no multicopter flies
}

STATE_BITS = {
    mode: 1 << state | _MORE_STATES.get(mode, 0) for mode, state in NAVIGATION_STATES.items()
}
"""Navigation states of each mode as bits, as in the mode masks of checks."""


def custom_mode(mode: Mode) -> int:
    """Return PX4's custom_mode: main mode << 16 | sub mode << 24."""
    main, sub = MAIN_SUB[mode]
    return main << 16 | sub << 24


def named(mode: Mode) -> NavigationMode:
    """Return the number of a mode in messages."""
    return _NUMBERS[mode][3]
