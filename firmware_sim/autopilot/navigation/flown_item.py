"""Active mission item, and the test for its completion.

Source: PX4 1.16, MissionBlock::is_mission_item_reached_or_completed, for a multicopter.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

from airl_mav.core.constants import US_PER_S
from airl_mav.core.frames import Geodetic, geodetic_to_local, wrap_pi
from airl_mav.vehicle.rotation import Vec
from firmware_sim.autopilot.navigation.plan import NavCommand, PlanItem

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


class ExecutorState(NamedTuple):
    """Flight state for the executor."""

    time_us: int
    position: Vec
    """Local NED [m]."""
    yaw: float
    """Heading [rad]."""
    landed: bool
    home: Geodetic
    origin: Geodetic
    """Geodetic origin of local NED."""
    velocity: Vec = (0.0, 0.0, 0.0)
    """NED [m/s]."""

    def local(self, place: Geodetic) -> Vec:
        """Return a place in local NED [m]."""
        north, east, down = geodetic_to_local(place, self.origin).tolist()
        return north, east, down


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

    def is_done(self, flown: FlownItem, target: Vec, now: ExecutorState) -> bool:
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

    def _is_there(self, flown: FlownItem, target: Vec, now: ExecutorState) -> bool:
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
