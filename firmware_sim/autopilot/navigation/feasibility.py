"""Whether a mission can be flown: PX4's checks, before the mission is.

Source of checks and texts: PX4 1.16, FeasibilityChecker (as it treats a multicopter) and
MissionFeasibilityChecker.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from airl_mav.core.frames import Geodetic
from firmware_sim.autopilot.autopilot_state import Message, Severity
from firmware_sim.autopilot.navigation.geography import distance_m
from firmware_sim.autopilot.navigation.plan import NavCommand, PlanItem

_N = NavCommand

FLYABLE = frozenset(_N) - {
    _N.ROI,
    _N.CONDITION_DELAY,
    _N.CONDITION_DISTANCE,
    _N.FENCE_RETURN_POINT,
    _N.FENCE_POLYGON_VERTEX_INCLUSION,
    _N.FENCE_POLYGON_VERTEX_EXCLUSION,
    _N.FENCE_CIRCLE_INCLUSION,
    _N.FENCE_CIRCLE_EXCLUSION,
    _N.RALLY_POINT,
}
"""Commands that a mission may consist of; the others are stored, and the mission is rejected."""

_VTOL = (_N.VTOL_TAKEOFF, _N.VTOL_LAND, _N.DO_VTOL_TRANSITION)
_TAKEOFFS = (_N.TAKEOFF, _N.VTOL_TAKEOFF)
_NEVER_FIRST = frozenset(
    {_N.WAYPOINT, _N.LOITER_UNLIM, _N.LOITER_TIME, _N.LOITER_TO_ALT, _N.LAND, *_TAKEOFFS}
    | {_N.VTOL_LAND, _N.CONDITION_GATE, _N.RETURN_TO_LAUNCH, _N.DO_WINCH, _N.DO_GRIPPER}
    | {_N.DO_SET_ACTUATOR}
)
"""After one of these a take-off is no longer the first waypoint, by PX4's reckoning."""


class Verdict(NamedTuple):
    """What the checks found."""

    valid: bool
    messages: tuple[Message, ...] = ()


def check(
    items: tuple[PlanItem, ...],
    home: Geodetic | None,
    value: Callable[[str], float],
    *,
    landed: bool,
    inside_fence: Callable[[Geodetic], bool],
) -> Verdict:
    """Check a mission.

    Args:
        items: The mission.
        home: None = not known yet.
        value: Looks up a PX4 parameter by its name.
        landed: Whether the vehicle stands on the ground.
        inside_fence: Whether the geofence allows a place.
    """
    if not items:
        return Verdict(valid=False)
    if home is None:
        text = "Not yet ready for mission, no position lock."
        return Verdict(False, (Message(Severity.INFO, text),))
    found = _first_invalid(items, landed=landed)
    if found is None:
        found = [
            *_takeoffs(items, home),
            *_vehicle_type(items),
            *_required(items, round(value("MIS_TKO_LAND_REQ")), landed=landed),
        ]
    found += _fence(items, home, inside_fence)
    warnings = _first_far_away(items, home, value("MIS_DIST_1WP"))
    return Verdict(not found, tuple(_critical(text) for text in [*warnings, *found]))


def _critical(text: str) -> Message:
    return Message(Severity.CRITICAL, text)


def _first_invalid(items: tuple[PlanItem, ...], *, landed: bool) -> list[str] | None:
    for number, item in enumerate(items, start=1):
        if item.command not in FLYABLE:
            return [f"Mission rejected: item {number}: unsupported cmd: {item.command}"]
        if number == 1 and item.command == _N.LAND and landed:
            return ["Mission rejected: starts with landing"]
    return None


def _takeoffs(items: tuple[PlanItem, ...], home: Geodetic) -> list[str]:
    passed = False
    for item in items:
        if item.command in _TAKEOFFS:
            if item.place(home.altitude_m).altitude_m <= home.altitude_m:
                return ["Mission rejected: Takeoff altitude below home altitude!"]
            if passed:
                return ["Mission rejected: takeoff not first waypoint item"]
        passed = passed or item.command in _NEVER_FIRST
    return []


def _vehicle_type(items: tuple[PlanItem, ...]) -> list[str]:
    if any(item.command in _VTOL for item in items):
        return ["Mission rejected: Mission contains VTOL items but vehicle is not a VTOL"]
    return []


def _required(items: tuple[PlanItem, ...], required: int, *, landed: bool) -> list[str]:
    """Return what MIS_TKO_LAND_REQ asks for and the mission lacks."""
    commands = {item.command for item in items}
    takeoff, land = not commands.isdisjoint(_TAKEOFFS), _N.LAND in commands
    missing = {
        1: None if takeoff else "Takeoff waypoint required.",
        2: None if land else "Landing waypoint/pattern required.",
        3: None if takeoff and land else "Takeoff or Landing item missing.",
        4: _not_both(takeoff=takeoff, land=land),
        5: _not_both(takeoff=takeoff, land=land)
        if landed
        else (None if land else "Landing waypoint/pattern required."),
    }.get(required)
    return [] if missing is None else [f"Mission rejected: {missing}"]


def _not_both(*, takeoff: bool, land: bool) -> str | None:
    if takeoff == land:
        return None
    if takeoff:
        return "Add Landing item or remove Takeoff."
    return "Add Takeoff item or remove Landing."


def _fence(
    items: tuple[PlanItem, ...], home: Geodetic, inside_fence: Callable[[Geodetic], bool]
) -> list[str]:
    for number, item in enumerate(items, start=1):
        if item.has_position and not inside_fence(item.place(home.altitude_m)):
            return [f"Geofence violation for waypoint {number}"]
    return []


def _first_far_away(items: tuple[PlanItem, ...], home: Geodetic, most_m: float) -> list[str]:
    """Return the warning that the first waypoint is far off; it has no effect on validity."""
    first = next((item for item in items if item.has_position), None)
    if first is None or most_m <= 0.0:
        return []
    away = distance_m((first.x, first.y), (home.latitude_deg, home.longitude_deg))
    if not away >= most_m:
        return []
    return [f"First waypoint far away from home: {int(away)}m. Correct mission loaded?"]
