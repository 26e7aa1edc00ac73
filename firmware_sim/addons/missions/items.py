"""Items of missions: commands, jumps, the path of an item, and the test for its completion.

Source of commands, frames and limits: MAVLink common.xml and PX4 1.16 (navigation.h, dataman.h); of
jumps: MissionBase::getNonJumpItem, getNextPositionItems; of the completion, for a multicopter:
MissionBlock::is_mission_item_reached_or_completed.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum, IntEnum, auto
from typing import NamedTuple

from airl_mav.core.constants import US_PER_S
from airl_mav.core.frames import wrap_pi
from airl_mav.vehicle.rotation import Vec
from firmware_sim.autopilot.navigation.plan import MissionType, NavigationState, PlanItem, Plans


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
