"""Conversion between MISSION_ITEM, MISSION_ITEM_INT and `plan.PlanItem`.

Stored fields, rejections and downloads follow PX4 1.16. Source:
MavlinkMissionManager::parse_mavlink_mission_item, format_mavlink_mission_item.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Mapping
from types import MappingProxyType

from firmware_sim.addons.missions.items import NOT_IN_MISSIONS, NavCommand, PlanFrame
from firmware_sim.autopilot.navigation.plan import MissionType, PlanItem
from firmware_sim.mavlink.codec import WireMessage, crc32part, dialect

_N = NavCommand

_GLOBAL_FRAMES = (PlanFrame.GLOBAL, PlanFrame.GLOBAL_RELATIVE_ALT)
_INT_FRAMES = (PlanFrame.GLOBAL_INT, PlanFrame.GLOBAL_RELATIVE_ALT_INT)

_ROI_NONE, _ROI_WPNEXT, _ROI_WPINDEX, _ROI_LOCATION = 0, 1, 2, 3
"""Values of MAV_ROI."""

_Conversion = Callable[[float], float]


_as_is = float


def _nothing(_value: float) -> float:
    return 0.0  # a parameter that PX4 does not keep


def _flag(value: float) -> float:
    return 1.0 if value > 0.0 else 0.0


def _heading(value: float) -> float:
    return value % 360.0


def _whole(value: float) -> float:
    return float(int(value)) if math.isfinite(value) else 0.0


def _region(value: float) -> float | None:
    """Return the MAV_ROI value; None for NaN, which PX4 SITL does not match to any value."""
    return _whole(value) if math.isfinite(value) else None


def _rounded(value: float) -> float:
    return float(int(value + 0.5)) if math.isfinite(value) else 0.0


_PLACES: Mapping[int, tuple[_Conversion, _Conversion, _Conversion, _Conversion]] = MappingProxyType(
    {
        _N.WAYPOINT: (_as_is, _as_is, _nothing, _heading),
        _N.LOITER_UNLIM: (_nothing, _nothing, _as_is, _heading),
        _N.LOITER_TIME: (_as_is, _flag, _as_is, _flag),
        _N.LAND: (_nothing, _whole, _nothing, _heading),
        _N.TAKEOFF: (_nothing, _nothing, _nothing, _heading),
        _N.LOITER_TO_ALT: (_flag, _as_is, _nothing, _flag),
        _N.ROI: (_nothing, _nothing, _nothing, _nothing),
        _N.DO_SET_ROI: (_nothing, _nothing, _nothing, _nothing),
        _N.DO_SET_ROI_LOCATION: (_nothing, _nothing, _nothing, _nothing),
        _N.VTOL_TAKEOFF: (_nothing, _nothing, _nothing, _heading),
        _N.VTOL_LAND: (_nothing, _nothing, _nothing, _heading),
        _N.CONDITION_GATE: (_nothing, _nothing, _nothing, _nothing),
        _N.FENCE_RETURN_POINT: (_nothing, _nothing, _nothing, _nothing),
        _N.FENCE_POLYGON_VERTEX_INCLUSION: (_rounded, _nothing, _nothing, _nothing),
        _N.FENCE_POLYGON_VERTEX_EXCLUSION: (_rounded, _nothing, _nothing, _nothing),
        _N.FENCE_CIRCLE_INCLUSION: (_as_is, _nothing, _nothing, _nothing),
        _N.FENCE_CIRCLE_EXCLUSION: (_as_is, _nothing, _nothing, _nothing),
        _N.RALLY_POINT: (_nothing, _nothing, _nothing, _nothing),
    }
)
"""Conversion of parameters 1 to 4 for a download, by command with a position."""

_WITHOUT_PLACE = frozenset(_N) - _PLACES.keys() - {_N.SET_CAMERA_ZOOM} | {_N.ROI, _N.DO_SET_ROI}
"""Commands without a position, for the frame MISSION."""

_POLYGONS = (_N.FENCE_POLYGON_VERTEX_INCLUSION, _N.FENCE_POLYGON_VERTEX_EXCLUSION)

_CHECKED = struct.Struct("<BHB4f4s4sf")
"""Fields of PX4's checksum: frame, command, autocontinue, parameters 1 to 4, x, y, z."""


def is_int(message: WireMessage) -> bool:
    """Return True for a MISSION_ITEM_INT."""
    return bool(message.get_type() == "MISSION_ITEM_INT")


def parse(message: WireMessage) -> PlanItem | int:
    """Return the item of a MISSION_ITEM(_INT), or the MAV_MISSION_RESULT of its rejection."""
    frame, command, integer = message.frame, message.command, is_int(message)
    params = (message.param1, message.param2, message.param3, message.param4)
    x, y = float(message.x), float(message.y)
    roi = command in (_N.ROI, _N.DO_SET_ROI)
    # Integer frames are valid only in MISSION_ITEM_INT.
    if frame in _GLOBAL_FRAMES or (integer and frame in _INT_FRAMES):
        if command not in _PLACES:
            return int(dialect.MAV_MISSION_UNSUPPORTED)
        if roi and _region(message.param1) not in (_ROI_NONE, _ROI_LOCATION):
            return int(dialect.MAV_MISSION_INVALID_PARAM1)
        if not (math.isfinite(x) and math.isfinite(y)):
            # PX4 stores such a position but cannot fly to it.
            wrong_y = dialect.MAV_MISSION_INVALID_PARAM6_Y
            return int(wrong_y if math.isfinite(x) else dialect.MAV_MISSION_INVALID_PARAM5_X)
        if integer:
            x, y = x * 1e-7, y * 1e-7
    elif frame == PlanFrame.MISSION:
        # The frame MISSION marks commands without a position.
        if command not in _WITHOUT_PLACE:
            return int(dialect.MAV_MISSION_UNSUPPORTED)
        if roi and _region(message.param1) not in (_ROI_NONE, _ROI_WPNEXT, _ROI_WPINDEX):
            return int(dialect.MAV_MISSION_INVALID_PARAM1)
    else:
        return int(dialect.MAV_MISSION_UNSUPPORTED_FRAME)
    # PX4 stores NAV_ROI as DO_SET_ROI.
    if command == _N.ROI:
        command = int(_N.DO_SET_ROI)
    return PlanItem(command, frame, params, x, y, float(message.z), bool(message.autocontinue))


def belongs(item: PlanItem, kind: MissionType) -> bool:
    """Return True if an item is valid in a list of this type. Polygons need 3 vertices."""
    if kind is MissionType.MISSION:
        return item.command not in NOT_IN_MISSIONS
    if kind is MissionType.FENCE and item.command in _POLYGONS:
        return _rounded(item.params[0]) >= 3
    return True


def format_item(
    item: PlanItem,
    kind: MissionType,
    index: int,
    target: tuple[int, int],
    *,
    current: bool,
    integer: bool,
) -> WireMessage:
    """Return the MISSION_ITEM_INT (or MISSION_ITEM) for a download."""
    x: float = item.x
    y: float = item.y
    if item.frame == PlanFrame.MISSION:
        frame, params = int(PlanFrame.MISSION), item.params
        # PX4 stores the jump's target and count as integers.
        if item.command == _N.DO_JUMP:
            params = (_whole(params[0]), _whole(params[1]), params[2], params[3])
        x, y = (_fit(x), _fit(y)) if integer else (x, y)
    else:
        # PX4 does not store the frame of fence points: it reports a global frame.
        frame = _frame(
            relative=item.altitude_is_relative and kind is not MissionType.FENCE, integer=integer
        )
        # PX4's storage keeps only the parameters that it uses; downloads show the others as 0.
        conversions = _PLACES[item.command]
        first, second, third, fourth = (f(p) for f, p in zip(conversions, item.params, strict=True))
        params = (first, second, third, fourth)
        x, y = (_fit(x * 1e7), _fit(y * 1e7)) if integer else (x, y)
    build = (
        dialect.MAVLink_mission_item_int_message
        if integer
        else dialect.MAVLink_mission_item_message
    )
    flags = int(current), int(item.autocontinue)
    return build(*target, index, frame, item.command, *flags, *params, x, y, item.z, int(kind))


def _frame(*, relative: bool, integer: bool) -> int:
    if integer:
        return int(PlanFrame.GLOBAL_RELATIVE_ALT_INT if relative else PlanFrame.GLOBAL_INT)
    return int(PlanFrame.GLOBAL_RELATIVE_ALT if relative else PlanFrame.GLOBAL)


def _fit(value: float) -> int:
    """Return a coordinate as an int32."""
    if not math.isfinite(value):
        return 0
    return max(-(2**31), min(2**31 - 1, round(value)))


def checksum(message: WireMessage, previous: int) -> int:
    """Return PX4's list checksum (opaque id) after one more item: CRC-32 without inversion."""
    pack = struct.Struct("<i" if is_int(message) else "<f").pack
    four = (message.param1, message.param2, message.param3, message.param4)
    head = (message.frame, message.command, message.autocontinue)
    # Little-endian fields in PX4's order, integers of x and y only in MISSION_ITEM_INT.
    covered = _CHECKED.pack(*head, *four, pack(message.x), pack(message.y), message.z)
    return crc32part(covered, previous)
