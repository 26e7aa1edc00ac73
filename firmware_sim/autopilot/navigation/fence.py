"""The geofence as geometry: is a place inside? Pure.

Source: PX4 1.16, Geofence. Polygons are tested in degrees (W. R. Franklin's PNPOLY), circles by
their distance. All inclusions must hold the place, and no exclusion.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple, TypeAlias

from airl_mav.core.frames import Geodetic
from firmware_sim.autopilot.navigation.geography import distance_m
from firmware_sim.autopilot.navigation.plan import NavCommand, PlanItem

_POLYGONS = {
    NavCommand.FENCE_POLYGON_VERTEX_INCLUSION: True,
    NavCommand.FENCE_POLYGON_VERTEX_EXCLUSION: False,
}
_CIRCLES = {NavCommand.FENCE_CIRCLE_INCLUSION: True, NavCommand.FENCE_CIRCLE_EXCLUSION: False}


class Polygon(NamedTuple):
    """A polygon of the fence."""

    vertices: tuple[tuple[float, float], ...]
    """(latitude, longitude) [deg], in order; the last one is joined to the first."""
    inclusion: bool
    """Whether the vehicle must be inside; else outside."""

    def contains(self, latitude_deg: float, longitude_deg: float) -> bool:
        """Return whether a place is inside."""
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
    """A circle of the fence."""

    center: tuple[float, float]
    """(latitude, longitude) [deg]."""
    radius_m: float
    inclusion: bool
    """Whether the vehicle must be inside; else outside."""

    def contains(self, latitude_deg: float, longitude_deg: float) -> bool:
        """Return whether a place is inside."""
        return distance_m(self.center, (latitude_deg, longitude_deg)) < self.radius_m


Area: TypeAlias = "Polygon | Circle"


def areas(items: Sequence[PlanItem]) -> Iterator[Area]:
    """Return the polygons and circles of a stored fence; what is neither is passed over."""
    index = 0
    while index < len(items):
        item = items[index]
        radius_or_count = item.params[0] if math.isfinite(item.params[0]) else 0.0
        if item.command in _CIRCLES:
            inclusion = _CIRCLES[NavCommand(item.command)]
            yield Circle((item.x, item.y), radius_or_count, inclusion)
        elif item.command in _POLYGONS:
            count = max(1, int(radius_or_count + 0.5))
            corners = items[index : index + count]
            inclusion = _POLYGONS[NavCommand(item.command)]
            yield Polygon(tuple((corner.x, corner.y) for corner in corners), inclusion)
            index += count
            continue
        index += 1


def allows(area: Area, place: Geodetic) -> bool:
    """Return whether an area of the fence allows a place."""
    return area.contains(place.latitude_deg, place.longitude_deg) == area.inclusion


def all_allow(fence: Iterable[Area], place: Geodetic) -> bool:
    """Return whether every area allows a place."""
    return all(allows(area, place) for area in fence)
