"""Plans stored on board: mission, geofence, rally points; with jumps and distances.

Source of commands, frames and limits: MAVLink common.xml and PX4 1.16 (navigation.h, dataman.h); of
jumps: MissionBase::getNonJumpItem, getNextPositionItems.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum, IntEnum, auto
from typing import NamedTuple

from airl_mav.core.constants import EARTH_RADIUS_M
from airl_mav.core.frames import Geodetic
from airl_mav.vehicle.rotation import Vec


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


class MissionType(IntEnum):
    """MAV_MISSION_TYPE."""

    MISSION = 0
    FENCE = 1
    RALLY = 2


MOST_ITEMS = {MissionType.MISSION: 65_534, MissionType.FENCE: 64, MissionType.RALLY: 32}
"""Maximum number of items per list, as in PX4's SITL."""

POSITION_COMMANDS = frozenset(
    {
        NavCommand.WAYPOINT,
        NavCommand.LOITER_UNLIM,
        NavCommand.LOITER_TIME,
        NavCommand.LAND,
        NavCommand.TAKEOFF,
        NavCommand.LOITER_TO_ALT,
        NavCommand.VTOL_TAKEOFF,
        NavCommand.VTOL_LAND,
    }
)
"""Commands with a place to fly to (MissionBlock::item_contains_position)."""

_RELATIVE = (PlanFrame.GLOBAL_RELATIVE_ALT, PlanFrame.GLOBAL_RELATIVE_ALT_INT)


@dataclass(frozen=True, slots=True)
class PlanItem:
    """Item of a mission, fence or list of rally points."""

    command: int
    """MAV_CMD."""
    frame: int
    """MAV_FRAME."""
    params: tuple[float, float, float, float]
    """Parameters 1..4; angles in degrees as on the wire, NaN = not given."""
    x: float
    """Latitude [deg]; parameter 5 in frame MISSION."""
    y: float
    """Longitude [deg]; parameter 6 in frame MISSION."""
    z: float
    """Altitude [m] above mean sea level or home, by the frame; parameter 7 in frame MISSION."""
    autocontinue: bool = True
    """True if the mission continues automatically after the item."""

    @property
    def has_position(self) -> bool:
        """True if the item has a place to fly to."""
        return self.command in POSITION_COMMANDS

    @property
    def altitude_is_relative(self) -> bool:
        """True if the altitude is relative to home."""
        return self.frame in _RELATIVE

    def place(self, home_altitude_m: float) -> Geodetic:
        """Return the item's place for a home altitude above mean sea level [m]."""
        above = home_altitude_m if self.altitude_is_relative else 0.0
        return Geodetic(self.x, self.y, self.z + above)


class Stored(NamedTuple):
    """Stored list of items."""

    items: tuple[PlanItem, ...] = ()
    identity: int = 0
    """PX4's opaque id of the list, a checksum; 0 = empty."""
    revision: int = 0
    """Number of changes."""


class Plans:
    """Storage of all plans and of the mission progress: PX4's dataman.

    It persists with the autopilot, through landings and disarming.
    """

    def __init__(self) -> None:
        self._stored = {kind: Stored() for kind in MissionType}
        self.current = 0
        """Index of the active mission item, or of the next item if the mission is paused."""
        self.set_current_count = 0
        """Number of client selections of the current item."""
        self.changes = 0
        """Number of stored lists and client selections."""
        self.reached = -1
        """Index of the newest reached item; -1 = none in this run."""
        self.jumps_done: dict[int, int] = {}
        """Number of executions of each DO_JUMP, by index."""
        self.jumped = -1
        """Index of the newest DO_JUMP with a changed count; -1 = none."""
        self.receiving = False
        """True while a list is being uploaded, on any link."""

    @property
    def progress(self) -> tuple[int, int, int, int]:
        """Mission progress: current and reached item, newest DO_JUMP and its count."""
        return self.current, self.reached, self.jumped, self.jumps_done.get(self.jumped, 0)

    def stored(self, kind: MissionType) -> Stored:
        """Return a stored list."""
        return self._stored[kind]

    @property
    def mission(self) -> tuple[PlanItem, ...]:
        """Items of the mission."""
        return self._stored[MissionType.MISSION].items

    def store(
        self, kind: MissionType, items: tuple[PlanItem, ...], identity: int, current: int = -1
    ) -> None:
        """Replace a list.

        `current` is the first mission item; -1 = the current index, at most the last item.
        """
        self.changes += 1
        self._stored[kind] = Stored(items, identity, self._stored[kind].revision + 1)
        if kind is MissionType.MISSION:
            self.current = current if current >= 0 else min(self.current, max(0, len(items) - 1))
            self.jumps_done.clear()
            self.jumped = -1
            self.reached = -1

    def clear(self, kind: MissionType) -> None:
        """Delete a list."""
        self.store(kind, (), 0, 0)

    def set_current(self, index: int) -> None:
        """Set the current mission item on a client's request. Raises IndexError."""
        if not 0 <= index < len(self.mission):
            raise IndexError(f"mission item {index}: there are {len(self.mission)}")
        self.current = index
        self.set_current_count += 1
        self.changes += 1


def distance_m(a: tuple[float, float], b: tuple[float, float]) -> float:
    """Return the great-circle distance [m] between two places (latitude, longitude) [deg].

    Haversine on a sphere, like PX4's get_distance_to_next_waypoint.
    """
    lat_a, lat_b = math.radians(a[0]), math.radians(b[0])
    half_lat = math.sin(0.5 * (lat_b - lat_a))
    half_lon = math.sin(0.5 * math.radians(b[1] - a[1]))
    h = half_lat * half_lat + half_lon * half_lon * math.cos(lat_a) * math.cos(lat_b)
    return EARTH_RADIUS_M * 2.0 * math.atan2(math.sqrt(h), math.sqrt(max(0.0, 1.0 - h)))


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
