"""Items of missions: commands, jumps, the path of an item, and the test for its completion.

Source of commands, frames and limits: MAVLink common.xml and PX4 1.16 (navigation.h, dataman.h); of
jumps: MissionBase::getNonJumpItem, getNextPositionItems; of the completion, for a multicopter:
MissionBlock::is_mission_item_reached_or_completed; of the conversion of MISSION_ITEM and
MISSION_ITEM_INT: MavlinkMissionManager::parse_mavlink_mission_item, format_mavlink_mission_item.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import Enum, IntEnum, auto
from types import MappingProxyType
from typing import NamedTuple

from airl_mav.core.constants import US_PER_S
from airl_mav.core.frames import wrap_pi
from airl_mav.vehicle.rotation import Vec
from firmware_sim.autopilot.navigation.plan import MissionType, NavigationState, PlanItem, Plans
from firmware_sim.mavlink.codec import WireMessage, crc32part, dialect


class TripletKind(Enum):
    """Type of a triplet."""

    IDLE = auto()
    """No flight: the vehicle is on the ground."""
    TAKEOFF = auto()
    """Take-off, slow at first."""
    POSITION = auto()
    """Flight to the target, continuing to the next waypoint."""
    LOITER = auto()
    """Flight to the target, with a stay."""
    LAND = auto()
    """Landing."""


class Triplet(NamedTuple):
    """Path of a mission. Places are local NED [m]."""

    kind: TripletKind
    target: Vec
    previous: Vec | None = None
    """Start of the path; None = the vehicle's position."""
    next: Vec | None = None
    """Next waypoint; None = the vehicle stops at the target."""
    yaw: float = math.nan
    """Heading [rad]; NaN = by MPC_YAW_MODE."""
    acceptance_m: float = 0.0
    precision: int = 0
    """Precision landing: 0 = off, 1 = on a target visible at once, 2 = search for the target."""
    cruise_m_s: float = math.nan
    """Cruise speed [m/s]; NaN = MPC_XY_CRUISE."""

    def same_target(self, other: Triplet) -> bool:
        """Return whether both have the same target and attributes."""
        return self._replace(previous=None, next=None) == other._replace(previous=None, next=None)


STANDING = Triplet(TripletKind.IDLE, (0.0, 0.0, 0.0))
"""Triplet without flight."""


class NavCommand(IntEnum):
    """MAV_CMD of supported plan items; values are MAVLink's."""

    WAYPOINT = 16
    LOITER_UNLIM = 17
    LOITER_TIME = 19
    RETURN_TO_LAUNCH = 20
    LAND = 21
    TAKEOFF = 22
    LOITER_TO_ALT = 31
    ROI = 80
    VTOL_TAKEOFF = 84
    VTOL_LAND = 85
    DELAY = 93
    CONDITION_DELAY = 112
    CONDITION_DISTANCE = 114
    DO_JUMP = 177
    DO_CHANGE_SPEED = 178
    DO_SET_HOME = 179
    DO_LAND_START = 189
    DO_SET_ROI_LOCATION = 195
    DO_SET_ROI_WPNEXT_OFFSET = 196
    DO_SET_ROI_NONE = 197
    DO_CONTROL_VIDEO = 200
    DO_SET_ROI = 201
    DO_DIGICAM_CONTROL = 203
    DO_MOUNT_CONFIGURE = 204
    DO_MOUNT_CONTROL = 205
    DO_SET_CAM_TRIGG_DIST = 206
    DO_SET_ACTUATOR = 187
    DO_GRIPPER = 211
    DO_SET_CAM_TRIGG_INTERVAL = 214
    OBLIQUE_SURVEY = 260
    SET_CAMERA_MODE = 530
    SET_CAMERA_ZOOM = 531
    SET_CAMERA_FOCUS = 532
    SET_CAMERA_SOURCE = 534
    DO_GIMBAL_MANAGER_PITCHYAW = 1000
    DO_GIMBAL_MANAGER_CONFIGURE = 1001
    IMAGE_START_CAPTURE = 2000
    IMAGE_STOP_CAPTURE = 2001
    DO_TRIGGER_CONTROL = 2003
    VIDEO_START_CAPTURE = 2500
    VIDEO_STOP_CAPTURE = 2501
    DO_VTOL_TRANSITION = 3000
    CONDITION_GATE = 4501
    FENCE_RETURN_POINT = 5000
    FENCE_POLYGON_VERTEX_INCLUSION = 5001
    FENCE_POLYGON_VERTEX_EXCLUSION = 5002
    FENCE_CIRCLE_INCLUSION = 5003
    FENCE_CIRCLE_EXCLUSION = 5004
    RALLY_POINT = 5100
    DO_WINCH = 42600


NOT_IN_MISSIONS = frozenset(
    {
        NavCommand.FENCE_POLYGON_VERTEX_INCLUSION,
        NavCommand.FENCE_POLYGON_VERTEX_EXCLUSION,
        NavCommand.FENCE_CIRCLE_INCLUSION,
        NavCommand.FENCE_CIRCLE_EXCLUSION,
        NavCommand.RALLY_POINT,
    }
)
"""Fence points and rally points."""


class PlanFrame(IntEnum):
    """MAV_FRAME of plan items."""

    GLOBAL = 0
    MISSION = 2
    """No place: seven parameters."""
    GLOBAL_RELATIVE_ALT = 3
    GLOBAL_INT = 5
    GLOBAL_RELATIVE_ALT_INT = 6


MOST_ITEMS = {MissionType.MISSION: 65_534, MissionType.FENCE: 64, MissionType.RALLY: 32}
"""Maximum number of items per list, as in PX4's SITL."""


MOST_JUMPS = 10
"""Maximum number of consecutive jumps before the search stops (PX4's MAX_JUMP_ITERATION)."""


def resolve(plans: Plans, index: int, *, count: bool) -> int | None:
    """Return the index of the item to fly after resolving DO_JUMP.

    Args:
        plans: Mission with its jump counts.
        index: First index.
        count: True if jumps count as executed.

    Returns:
        None at the end of the mission, or if a jump leads out of it.
    """
    items = plans.mission
    for _ in range(MOST_JUMPS):
        if not 0 <= index < len(items):
            return None
        item = items[index]
        if item.command != NavCommand.DO_JUMP:
            return index
        target, repeats = _whole(item.params[0]), _whole(item.params[1])
        if not 0 <= target < len(items):
            return None
        done = plans.jumps_done.get(index, 0)
        if done < repeats:
            if count:
                plans.jumps_done[index] = done + 1
                plans.jumped = index
            index = target
        else:
            index += 1
    return index if 0 <= index < len(items) else None


def go_to(plans: Plans, index: int) -> int | None:
    """Return the item to fly for an index, and count the jumps; None = end."""
    return resolve(plans, index, count=True)


def next_places(plans: Plans, index: int, most: int) -> list[PlanItem]:
    """Return up to `most` next items with a place, starting at an index."""
    found: list[PlanItem] = []
    # Bounded, so that mutual jumps end.
    for _ in range(2 * len(plans.mission)):
        if len(found) == most:
            break
        following = resolve(plans, index, count=False)
        if following is None:
            break
        if plans.mission[following].has_position:
            found.append(plans.mission[following])
        index = following + 1
    return found


def _whole(value: float) -> int:
    """Return a number of the wire as in PX4, truncated; -1 if out of range or NaN."""
    return int(value) if abs(value) < 65_536.0 else -1


_N = NavCommand

AT_ONCE = frozenset(
    {
        _N.DO_SET_ACTUATOR,
        _N.DO_LAND_START,
        _N.DO_TRIGGER_CONTROL,
        _N.DO_DIGICAM_CONTROL,
        _N.IMAGE_START_CAPTURE,
        _N.IMAGE_STOP_CAPTURE,
        _N.VIDEO_START_CAPTURE,
        _N.VIDEO_STOP_CAPTURE,
        _N.DO_CONTROL_VIDEO,
        _N.DO_MOUNT_CONFIGURE,
        _N.DO_MOUNT_CONTROL,
        _N.DO_GIMBAL_MANAGER_CONFIGURE,
        _N.DO_SET_ROI,
        _N.DO_SET_ROI_LOCATION,
        _N.DO_SET_ROI_WPNEXT_OFFSET,
        _N.DO_SET_ROI_NONE,
        _N.DO_SET_CAM_TRIGG_DIST,
        _N.OBLIQUE_SURVEY,
        _N.DO_SET_CAM_TRIGG_INTERVAL,
        _N.SET_CAMERA_MODE,
        _N.SET_CAMERA_SOURCE,
        _N.SET_CAMERA_ZOOM,
        _N.SET_CAMERA_FOCUS,
        _N.DO_CHANGE_SPEED,
        _N.DO_SET_HOME,
    }
)
"""Commands that are complete once issued."""

WITH_TIMEOUT = (_N.DO_WINCH, _N.DO_GRIPPER, _N.DO_GIMBAL_MANAGER_PITCHYAW)
"""Commands that are complete after MIS_COMMAND_TOUT."""

_PRECISE = (1.0, 2.0)
"""PRECISION_LAND_MODE in parameter 2 of a landing: opportunistic, required."""

_STAYS = (_N.WAYPOINT, _N.LOITER_TIME, _N.DELAY)
"""Commands with a stay [s] in parameter 1."""


@dataclass(slots=True)
class FlownItem:
    """Active item with its current values."""

    command: int
    place: Vec
    """Place, local NED [m]; undefined for items without a place."""
    yaw: float = math.nan
    """Target heading [rad]; NaN = any."""
    stay_s: float = 0.0
    acceptance_m: float = 0.0
    """Acceptance radius [m]; 0 = NAV_ACC_RAD."""
    autocontinue: bool = True
    precision: int = 0
    """Precision landing mode, as in `Triplet`."""


def as_flown(item: PlanItem, place: Vec) -> FlownItem:
    """Return an active item for a place in local NED [m]."""
    first, radius, _, heading = item.params
    yaw = math.radians(heading) if item.has_position else math.nan
    return FlownItem(
        item.command,
        place,
        wrap_pi(yaw) if math.isfinite(yaw) else math.nan,
        max(first, 0.0) if item.command in _STAYS and math.isfinite(first) else 0.0,
        radius if item.command == _N.WAYPOINT and math.isfinite(radius) else 0.0,
        item.autocontinue,
        int(radius) if item.command == _N.LAND and radius in _PRECISE else 0,
    )


class Arrival:
    """Completion test of successive items: position reached, heading reached, stay over."""

    def __init__(self, value: Callable[[str], float]) -> None:
        """Store the look-up for PX4 parameters."""
        self._value = value
        self._since_us: int | None = None
        """Time of arrival [µs]; None = not there."""
        self._turned = False
        self._issued_us = 0

    def restart(self) -> None:
        """Start with an item."""
        self._since_us, self._turned = None, False

    def issued(self, time_us: int) -> None:
        """Record the time of an item's command [µs]."""
        self._issued_us = time_us

    def acceptance_m(self, flown: FlownItem) -> float:
        """Return the acceptance radius of an item [m]."""
        return flown.acceptance_m if flown.acceptance_m > 0.0 else self._value("NAV_ACC_RAD")

    def is_done(self, flown: FlownItem, target: Vec, now: NavigationState) -> bool:
        """Return whether an item is complete; `target` is the vehicle's destination."""
        if flown.command in AT_ONCE:
            return True
        if flown.command == _N.LAND:
            return now.landed
        if flown.command in (_N.LOITER_UNLIM, _N.RETURN_TO_LAUNCH):
            return False
        if flown.command in WITH_TIMEOUT:
            return now.time_us > self._issued_us + self._value("MIS_COMMAND_TOUT") * US_PER_S
        if self._since_us is None and self._is_there(flown, target, now):
            self._since_us = now.time_us
        if self._since_us is None:
            return False
        if not self._turned:
            wrong = abs(wrap_pi(flown.yaw - now.yaw))
            self._turned = (
                math.isnan(wrong)
                or wrong < math.radians(self._value("MIS_YAW_ERR"))
                # With a timeout set, a heading that is not forced is ignored.
                or self._value("MIS_YAW_TMT") > 0.0
            )
        return self._turned and now.time_us >= self._since_us + flown.stay_s * US_PER_S

    def _is_there(self, flown: FlownItem, target: Vec, now: NavigationState) -> bool:
        if flown.command == _N.DELAY:
            return True
        if now.landed:
            return False
        north, east, down = (a - b for a, b in zip(now.position, flown.place, strict=True))
        if flown.command == _N.CONDITION_GATE:
            # Past the gate: between it and the next waypoint.
            ahead = target[0] - flown.place[0], target[1] - flown.place[1]
            return north * ahead[0] + east * ahead[1] >= 0.0
        away, near = math.hypot(north, east), self._value("NAV_MC_ALT_RAD")
        if flown.command == _N.TAKEOFF:
            above_m = now.local(now.home)[2] - flown.place[2]
            if 0.0 < above_m < near:
                near = above_m / 2.0
            return down < near
        if flown.command == _N.LOITER_TO_ALT:
            away = max(0.0, away - self._value("NAV_LOITER_RAD"))
        return away <= self.acceptance_m(flown) and abs(down) <= near


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


def _integer(value: float) -> float:
    return float(int(value)) if math.isfinite(value) else 0.0


def _region(value: float) -> float | None:
    """Return the MAV_ROI value; None for NaN, which PX4 SITL does not match to any value."""
    return _integer(value) if math.isfinite(value) else None


def _rounded(value: float) -> float:
    return float(int(value + 0.5)) if math.isfinite(value) else 0.0


_PLACES: Mapping[int, tuple[_Conversion, _Conversion, _Conversion, _Conversion]] = MappingProxyType(
    {
        _N.WAYPOINT: (_as_is, _as_is, _nothing, _heading),
        _N.LOITER_UNLIM: (_nothing, _nothing, _as_is, _heading),
        _N.LOITER_TIME: (_as_is, _flag, _as_is, _flag),
        _N.LAND: (_nothing, _integer, _nothing, _heading),
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
            params = (_integer(params[0]), _integer(params[1]), params[2], params[3])
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
