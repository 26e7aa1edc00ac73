"""Feasibility checks of a mission, as in PX4.

Source of checks and texts: PX4 1.16, FeasibilityChecker (for a multicopter) and
MissionFeasibilityChecker.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from airl_mav.core.frames import Geodetic
from firmware_sim.addons.missions.items import NOT_IN_MISSIONS, NavCommand
from firmware_sim.autopilot.autopilot_state import OperatorText, Severity
from firmware_sim.autopilot.events.definition import Definition, Level, define, error, warning
from firmware_sim.autopilot.navigation.plan import PlanItem, distance_m

_N = NavCommand

FLYABLE = (
    frozenset(_N)
    - {_N.ROI, _N.CONDITION_DELAY, _N.CONDITION_DISTANCE, _N.FENCE_RETURN_POINT}
    - NOT_IN_MISSIONS
)
"""Supported commands; a mission with others is stored but rejected."""

_VTOL = (_N.VTOL_TAKEOFF, _N.VTOL_LAND, _N.DO_VTOL_TRANSITION)
_TAKEOFFS = (_N.TAKEOFF, _N.VTOL_TAKEOFF)
_NEVER_FIRST = frozenset(
    {_N.WAYPOINT, _N.LOITER_UNLIM, _N.LOITER_TIME, _N.LOITER_TO_ALT, _N.LAND, *_TAKEOFFS}
    | {_N.VTOL_LAND, _N.CONDITION_GATE, _N.RETURN_TO_LAUNCH, _N.DO_WINCH, _N.DO_GRIPPER}
    | {_N.DO_SET_ACTUATOR}
)
"""Commands after which PX4 no longer counts a take-off as the first waypoint."""


def _rejected(name: str, words: str, listed: str = "", internal: Level = Level.INFO) -> Definition:
    return define(name, f"Mission rejected: {words}", listed, level=Level.ERROR, internal=internal)


NO_POSITION = define("navigator_mis_no_pos_lock", "Not yet ready for mission, no position lock")
UNSUPPORTED_COMMAND = _rejected(
    "navigator_mis_unsup_cmd",
    "item {1}: unsupported command: {2}",
    "uint16_t item, uint16_t nav_cmd",
    internal=Level.WARNING,
)
STARTS_WITH_LANDING = _rejected("navigator_mis_starts_w_landing", "starts with landing")
TAKEOFF_TOO_LOW = _rejected(
    "navigator_mis_takeoff_too_low", "takeoff altitude too low! Minimum: {1:.1m_v}", "float minimum"
)
TAKEOFF_NOT_FIRST = _rejected(
    "navigator_mis_takeoff_not_first", "takeoff is not the first waypoint item"
)
VTOL_ITEMS = _rejected(
    "navigator_mis_vtol_items", "Mission contains VTOL items but vehicle is not a VTOL"
)
TAKEOFF_MISSING = _rejected("navigator_mis_takeoff_missing", "Takeoff waypoint required")
LAND_MISSING = _rejected("navigator_mis_land_missing", "Landing waypoint/pattern required")
LAND_MISSING_IN_AIR = _rejected(
    "feasibility_mis_in_air_landing_req", "Landing waypoint/pattern required"
)
TAKEOFF_OR_LAND_MISSING = _rejected(
    "navigator_mis_takeoff_or_land_missing", "Takeoff or Landing item missing"
)
ADD_LANDING = _rejected("navigator_mis_add_land_or_rm_to", "Add Landing item or remove Takeoff")
ADD_TAKEOFF = _rejected("navigator_mis_add_to_or_rm_land", "Add Takeoff item or remove Landing")
OUTSIDE_FENCE = error(
    "navigator_mis_geofence_violation", "Geofence violation for waypoint {1}", "int16_t waypoint"
)
FIRST_FAR_AWAY = warning(
    "navigator_mis_first_wp_far",
    "First waypoint far away from Home: {1m} Correct mission loaded?",
    "uint32_t distance",
)


class FeasibilityResult(NamedTuple):
    """Result of the checks."""

    valid: bool
    messages: tuple[OperatorText, ...] = ()


def check(
    items: tuple[PlanItem, ...],
    home: Geodetic | None,
    value: Callable[[str], float],
    *,
    landed: bool,
    inside_fence: Callable[[Geodetic], bool],
) -> FeasibilityResult:
    """Check a mission.

    Args:
        items: Mission items.
        home: Home position; None = unknown.
        value: Look-up for PX4 parameters by name.
        landed: True if the vehicle is on the ground.
        inside_fence: Returns whether the geofence allows a place.
    """
    if not items:
        return FeasibilityResult(valid=False)
    if home is None:
        text = "Not yet ready for mission, no position lock."
        return FeasibilityResult(False, (OperatorText.of(Severity.INFO, NO_POSITION, text=text),))
    found = _first_invalid(items, landed=landed)
    if found is None:
        found = [
            *_takeoffs(items, home),
            *_vehicle_type(items),
            *_required(items, round(value("MIS_TKO_LAND_REQ")), landed=landed),
        ]
    found += _fence(items, home, inside_fence)
    warnings = _first_far_away(items, home, value("MIS_DIST_1WP"))
    return FeasibilityResult(not found, (*warnings, *found))


def _critical(definition: Definition, *values: float, text: str | None = None) -> OperatorText:
    return OperatorText.of(Severity.CRITICAL, definition, *values, text=text)


def _first_invalid(items: tuple[PlanItem, ...], *, landed: bool) -> list[OperatorText] | None:
    for number, item in enumerate(items, start=1):
        if item.command not in FLYABLE:
            text = f"Mission rejected: item {number}: unsupported cmd: {item.command}"
            return [_critical(UNSUPPORTED_COMMAND, number, item.command, text=text)]
        if number == 1 and item.command == _N.LAND and landed:
            return [_critical(STARTS_WITH_LANDING)]
    return None


def _takeoffs(items: tuple[PlanItem, ...], home: Geodetic) -> list[OperatorText]:
    passed = False
    for item in items:
        if item.command in _TAKEOFFS:
            if item.place(home.altitude_m).altitude_m <= home.altitude_m:
                text = "Mission rejected: Takeoff altitude below home altitude!"
                least = 0.0 if item.altitude_is_relative else home.altitude_m
                return [_critical(TAKEOFF_TOO_LOW, least, text=text)]
            if passed:
                text = "Mission rejected: takeoff not first waypoint item"
                return [_critical(TAKEOFF_NOT_FIRST, text=text)]
        passed = passed or item.command in _NEVER_FIRST
    return []


def _vehicle_type(items: tuple[PlanItem, ...]) -> list[OperatorText]:
    if any(item.command in _VTOL for item in items):
        return [_critical(VTOL_ITEMS)]
    return []


def _required(items: tuple[PlanItem, ...], required: int, *, landed: bool) -> list[OperatorText]:
    """Return the errors for items required by MIS_TKO_LAND_REQ."""
    commands = {item.command for item in items}
    takeoff, land = not commands.isdisjoint(_TAKEOFFS), _N.LAND in commands
    missing = {
        1: None if takeoff else TAKEOFF_MISSING,
        2: None if land else LAND_MISSING,
        3: None if takeoff and land else TAKEOFF_OR_LAND_MISSING,
        4: _not_both(takeoff=takeoff, land=land),
        5: _not_both(takeoff=takeoff, land=land)
        if landed
        else (None if land else LAND_MISSING_IN_AIR),
    }.get(required)
    return [] if missing is None else [_critical(missing, text=f"{missing.message}.")]


def _not_both(*, takeoff: bool, land: bool) -> Definition | None:
    if takeoff == land:
        return None
    return ADD_LANDING if takeoff else ADD_TAKEOFF


def _fence(
    items: tuple[PlanItem, ...], home: Geodetic, inside_fence: Callable[[Geodetic], bool]
) -> list[OperatorText]:
    for number, item in enumerate(items, start=1):
        if item.has_position and not inside_fence(item.place(home.altitude_m)):
            text = f"Geofence violation for waypoint {number}"
            return [_critical(OUTSIDE_FENCE, number, text=text)]
    return []


def _first_far_away(
    items: tuple[PlanItem, ...], home: Geodetic, most_m: float
) -> list[OperatorText]:
    """Return the warning for a distant first waypoint; it does not affect validity."""
    first = next((item for item in items if item.has_position), None)
    if first is None or most_m <= 0.0:
        return []
    away = distance_m((first.x, first.y), (home.latitude_deg, home.longitude_deg))
    if not away >= most_m:
        return []
    text = f"First waypoint far away from home: {int(away)}m. Correct mission loaded?"
    return [_critical(FIRST_FAR_AWAY, int(away), text=text)]
