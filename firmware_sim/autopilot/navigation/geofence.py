"""Geofence: areas, limits about home, and the monitor of breaches.

Source: PX4 1.16, Geofence, GeofenceBreachAvoidance (multirotor) and
Navigator::geofence_breach_check. The failsafes implement the response (GF_ACTION). Polygons are
tested in degrees (W. R. Franklin's PNPOLY), circles by distance. A place must be inside all
inclusions and outside all exclusions.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import NamedTuple, TypeAlias

import numpy as np

from airl_mav.core.constants import US_PER_S
from airl_mav.core.frames import Geodetic, local_to_geodetic
from airl_mav.vehicle.rotation import Vec
from firmware_sim.autopilot.autopilot_state import FenceStatus, OperatorText, Severity
from firmware_sim.autopilot.events import flight_events as events
from firmware_sim.autopilot.events.definition import Definition
from firmware_sim.autopilot.flight_modes import Mode
from firmware_sim.autopilot.navigation import plan
from firmware_sim.autopilot.smooth_trajectory import Axis

FENCE_PERIOD_US = 200_000
"""Period of PX4's fence check, 0.2 s, during which the vehicle flies on [µs]."""

_POLYGONS = {5001: True, 5002: False}
_CIRCLES = {5003: True, 5004: False}
"""MAV_CMD_NAV_FENCE_* of polygon vertices and circles: True = inclusion, False = exclusion."""


class Polygon(NamedTuple):
    """Polygon of the fence."""

    vertices: tuple[tuple[float, float], ...]
    """(latitude, longitude) [deg], in order; the last vertex connects to the first."""
    inclusion: bool
    """True if the vehicle must be inside, False if outside."""

    def contains(self, latitude_deg: float, longitude_deg: float) -> bool:
        """Return whether a place is inside the polygon."""
        inside = False
        before = self.vertices[-1]
        for vertex in self.vertices:
            if (vertex[1] >= longitude_deg) != (before[1] >= longitude_deg):
                share = (longitude_deg - vertex[1]) / (before[1] - vertex[1])
                if latitude_deg <= vertex[0] + share * (before[0] - vertex[0]):
                    inside = not inside
            before = vertex
        return inside


class Circle(NamedTuple):
    """Circle of the fence."""

    center: tuple[float, float]
    """(latitude, longitude) [deg]."""
    radius_m: float
    inclusion: bool
    """True if the vehicle must be inside, False if outside."""

    def contains(self, latitude_deg: float, longitude_deg: float) -> bool:
        """Return whether a place is inside the circle."""
        return plan.distance_m(self.center, (latitude_deg, longitude_deg)) < self.radius_m


Area: TypeAlias = "Polygon | Circle"


def areas(items: Sequence[plan.PlanItem]) -> Iterator[Area]:
    """Yield the polygons and circles of a stored fence; other items are skipped."""
    index = 0
    while index < len(items):
        item = items[index]
        radius_or_count = item.params[0] if math.isfinite(item.params[0]) else 0.0
        if item.command in _CIRCLES:
            yield Circle((item.x, item.y), radius_or_count, _CIRCLES[item.command])
        elif item.command in _POLYGONS:
            count = max(1, int(radius_or_count + 0.5))
            corners = items[index : index + count]
            vertices = tuple((corner.x, corner.y) for corner in corners)
            yield Polygon(vertices, _POLYGONS[item.command])
            index += count
            continue
        index += 1


def allows(area: Area, place: Geodetic) -> bool:
    """Return whether an area of the fence allows a place."""
    return area.contains(place.latitude_deg, place.longitude_deg) == area.inclusion


def all_allow(fence: Iterable[Area], place: Geodetic) -> bool:
    """Return whether every area allows a place."""
    return all(allows(area, place) for area in fence)


def point_ahead(place: Geodetic, velocity: Vec, value: Callable[[str], float]) -> Geodetic:
    """Return the predicted stopping point, which must be inside the fence.

    Args:
        place: Position of the vehicle.
        velocity: Velocity NED [m/s].
        value: Look-up for PX4 parameters by name.
    """
    north, east, down = velocity
    speed, jerk = math.hypot(north, east), value("MPC_JERK_AUTO")
    most = max(value("MPC_ACC_HOR"), value("MPC_ACC_HOR_MAX"))
    ahead_m = braking_distance(speed, value("MPC_ACC_HOR"), most, jerk)
    share = ahead_m / speed if speed > 0.0 else 0.0
    upward, downward = value("MPC_ACC_UP_MAX"), value("MPC_ACC_DOWN_MAX")
    limit = downward if down < 0.0 else upward  # a climb ends with downward acceleration
    below_m = math.copysign(braking_distance(abs(down), limit, max(upward, downward), jerk), down)
    offset = np.array([north * share, east * share, below_m if down else 0.0])
    return local_to_geodetic(offset, place)


def braking_distance(speed: float, limit: float, most: float, jerk: float) -> float:
    """Return the stopping distance plus the distance of one check period [m].

    As in PX4, braking starts from maximum acceleration.

    Args:
        speed: Initial speed [m/s].
        limit: Maximum deceleration [m/s²].
        most: Acceleration at the start of braking [m/s²].
        jerk: Maximum jerk, > 0 [m/s³].
    """
    axis = Axis()
    axis.restart(0.0, speed)
    axis.acceleration = most
    axis.plan(0.0, limit, jerk)
    axis.advance(axis.duration_s)
    return axis.position + FENCE_PERIOD_US / US_PER_S * speed


_HOLD = 2
"""GF_ACTION value of Hold."""


class FenceMonitor:
    """Fence storage and breach monitor."""

    def __init__(
        self,
        plans: plan.Plans,
        value: Callable[[str], float],
        say: Callable[[OperatorText], object],
    ) -> None:
        """Store the plans, the look-up for PX4 parameters, and the text callback."""
        self._plans, self._value, self._say = plans, value, say
        self.status = FenceStatus()
        """Active breaches and their count."""
        self._revision = 0
        self._areas: tuple[Area, ...] = ()
        self._due_us = 0
        self._holding = False
        """True if the vehicle holds due to a breach, which then stays active."""

    def inside(self, place: Geodetic, home: Geodetic) -> bool:
        """Return whether the fence and the limits about home allow a place."""
        far, high = self._limits(place, home)
        return not (far or high) and all_allow(self._areas, place)

    def step(self, now: plan.NavigationState, mode: Mode, place: Callable[[], Geodetic]) -> None:
        """Check the fence if due; `place` returns the position selected by GF_SOURCE."""
        if self._plans.stored(plan.MissionType.FENCE).revision != self._revision:
            self._take(now, place)
        if now.time_us < self._due_us:
            return
        self._due_us = now.time_us + FENCE_PERIOD_US
        action = round(self._value("GF_ACTION"))
        if self._holding and mode is not Mode.HOLD and any(self.status.breached):
            self._holding = False
        if action == 0 or not self.is_set:
            if any(self.status.breached):
                self.status = self.status._replace(distance=False, altitude=False, custom=False)
            return
        where = place()
        if self._value("GF_PREDICT") > 0.0:
            where = point_ahead(where, now.velocity, self._value)
        far, high = self._limits(where, now.home)
        found = (far, high, not all_allow(self._areas, where))
        before = self.status
        if self._holding:
            distance, altitude, custom = (
                a or b for a, b in zip(found, before.breached, strict=True)
            )
        else:
            distance, altitude, custom = found
        after = before._replace(distance=distance, altitude=altitude, custom=custom)
        if any(after.breached) and not any(before.breached):
            after = after._replace(breaches=before.breaches + 1, time_us=now.time_us)
            self._holding = action == _HOLD
        self.status = after

    @property
    def is_set(self) -> bool:
        """True if there are areas, or limits about home."""
        value = self._value
        limited = value("GF_MAX_HOR_DIST") > 0.0 or value("GF_MAX_VER_DIST") > 0.0
        return limited or bool(self._areas)

    def _limits(self, place: Geodetic, home: Geodetic) -> tuple[bool, bool]:
        """Return whether a place exceeds the distance from home, and the height above it."""
        farthest, highest = self._value("GF_MAX_HOR_DIST"), self._value("GF_MAX_VER_DIST")
        far = farthest > 0.0 and plan.distance_m(place[:2], home[:2]) >= farthest
        return far, highest > 0.0 and place.altitude_m - home.altitude_m >= highest

    def _take(self, now: plan.NavigationState, place: Callable[[], Geodetic]) -> None:
        """Load a new fence, without areas that home or the flying vehicle violates."""
        fence = self._plans.stored(plan.MissionType.FENCE)
        self._revision = fence.revision
        accepted = []
        for area in areas(fence.items):
            flying = not now.landed and self._value("GF_ACTION") > 0.0
            if not allows(area, now.home):
                self._refuse(events.FENCE_WITHOUT_HOME)
            elif flying and not allows(area, place()):
                self._refuse(events.FENCE_WITHOUT_VEHICLE)
            else:
                accepted.append(area)
        self._areas = tuple(accepted)

    def _refuse(self, why: Definition) -> None:
        self._say(OperatorText.of(Severity.CRITICAL, why))
