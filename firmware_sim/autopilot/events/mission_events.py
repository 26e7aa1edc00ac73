"""Events of missions that are rejected, and of transfers that go wrong.

Names, words, arguments and levels: PX4 1.16, navigator/MissionFeasibility/FeasibilityChecker.cpp,
navigator/mission_feasibility_checker.cpp, navigator/geofence.cpp, mavlink/mavlink_mission.cpp.
"""

from __future__ import annotations

from firmware_sim.autopilot.events.definition import (
    Definition,
    Level,
    define,
    error,
    warning,
)


def _rejected(name: str, words: str, listed: str = "", internal: Level = Level.INFO) -> Definition:
    return define(name, f"Mission rejected: {words}", listed, level=Level.ERROR, internal=internal)


def _transfer(name: str, message: str, level: Level = Level.ERROR) -> Definition:
    return define(f"mavlink_mission_{name}", message, level=level)


# --- what cannot be flown

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

# --- a fence that is left out

FENCE_WITHOUT_HOME = define(
    "navigator_geofence_invalid_against_home",
    "Geofence invalid, doesn't contain Home position",
    level=Level.CRITICAL,
    internal=Level.WARNING,
)
FENCE_WITHOUT_VEHICLE = define(
    "navigator_geofence_invalid_against_cur_pos",
    "Geofence invalid, doesn't contain current vehicle position",
    level=Level.CRITICAL,
    internal=Level.WARNING,
)

# --- transfers

DOWNLOAD_IGNORED = _transfer(
    "req_ignored", "Mission download request ignored, already active", Level.WARNING
)
REQUEST_OF_ANOTHER = _transfer(
    "partner_id_mismatch2", "Rejecting mission request command, component or system ID mismatch"
)
REQUEST_WHILE_BUSY = _transfer("mis_req_ignored_busy", "Ignoring mission request, currently busy")
REQUEST_UNEXPECTED = _transfer("wp_unexpected", "Unexpected waypoint index, aborting transfer")
REQUEST_BEYOND_END = _transfer(
    "wp_unexpected2", "Unexpected waypoint index, aborting mission transfer"
)
ACK_OF_ANOTHER = _transfer(
    "partner_id_mismatch", "Rejecting waypoint command, component or system ID mismatch"
)
COUNT_WHILE_SENDING = _transfer("ignore_mis_count", "Mission upload busy, ignoring MISSION_COUNT")
COUNT_WHILE_RECEIVING = _transfer("getlist_busy", "Mission upload busy, already receiving waypoint")
ITEM_OF_ANOTHER = _transfer(
    "item_partner_id_mismatch", "Rejecting mission item, component or system ID mismatch"
)
ITEM_WHILE_SENDING = _transfer("mis_item_busy", "Ignoring mission item, busy")
ITEM_WITHOUT_TRANSFER = _transfer("no_transfer", "Ignoring mission item, no transfer in progress")
ITEM_INVALID = _transfer("mis_item_invalid", "Ignoring mission item, invalid item")
CLEAR_WHILE_BUSY = _transfer("ignore_clear", "Ignoring mission clear command, busy")
CURRENT_WHILE_BUSY = _transfer(
    "state_busy", "Mission manager currently busy, ignoring new waypoint index"
)
CURRENT_NOT_LISTED = _transfer("seq_out_of_bounds", "New mission waypoint sequence out of bounds")
TIMED_OUT = _transfer("op_timeout", "Operation timeout, aborting transfer")
