"""Watches the geofence: the areas that were uploaded, and the limits about home.

Source: PX4 1.16, Geofence and Navigator::geofence_breach_check. What a breach leads to (GF_ACTION)
is the failsafes' business.
"""

from __future__ import annotations

from collections.abc import Callable

from airl_mav.core.frames import Geodetic
from firmware_sim.autopilot.autopilot_state import FenceStatus, Message, Mode, Severity
from firmware_sim.autopilot.events import mission_events as events
from firmware_sim.autopilot.events.definition import Definition
from firmware_sim.autopilot.navigation.fence import Area, all_allow, allows, areas
from firmware_sim.autopilot.navigation.fence_prediction import point_ahead
from firmware_sim.autopilot.navigation.flown_item import Situation
from firmware_sim.autopilot.navigation.geography import distance_m
from firmware_sim.autopilot.navigation.plan import Kind, Plans

PERIOD_US = 200_000
"""PX4 checks the fence every 0.2 s."""

_HOLD = 2
"""GF_ACTION."""


class FenceMonitor:
    """Keeps the fence and says whether it is breached."""

    def __init__(
        self, plans: Plans, value: Callable[[str], float], say: Callable[[Message], object]
    ) -> None:
        """Take the plans, a lookup of PX4 parameter names, and where texts go."""
        self._plans, self._value, self._say = plans, value, say
        self.status = FenceStatus()
        """What is breached now, and how often it was."""
        self._revision = 0
        self._areas: tuple[Area, ...] = ()
        self._due_us = 0
        self._holding = False
        """Whether the vehicle holds because of a breach: what is breached then stays so."""

    def inside(self, place: Geodetic, home: Geodetic) -> bool:
        """Return whether the fence and the limits about home allow a place."""
        far, high = self._limits(place, home)
        return not (far or high) and all_allow(self._areas, place)

    def step(self, now: Situation, mode: Mode, place: Callable[[], Geodetic]) -> None:
        """Check, when it is time; `place` is where the vehicle is, by GF_SOURCE."""
        if self._plans.stored(Kind.FENCE).revision != self._revision:
            self._take(now, place)
        if now.time_us < self._due_us:
            return
        self._due_us = now.time_us + PERIOD_US
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
        """Whether there are areas, or limits about home."""
        value = self._value
        limited = value("GF_MAX_HOR_DIST") > 0.0 or value("GF_MAX_VER_DIST") > 0.0
        return limited or bool(self._areas)

    def _limits(self, place: Geodetic, home: Geodetic) -> tuple[bool, bool]:
        """Return whether a place is too far from home, and whether it is too high above it."""
        farthest, highest = self._value("GF_MAX_HOR_DIST"), self._value("GF_MAX_VER_DIST")
        far = farthest > 0.0 and distance_m(place[:2], home[:2]) >= farthest
        return far, highest > 0.0 and place.altitude_m - home.altitude_m >= highest

    def _take(self, now: Situation, place: Callable[[], Geodetic]) -> None:
        """Take a new fence; an area that home or the flying vehicle violates is left out."""
        fence = self._plans.stored(Kind.FENCE)
        self._revision = fence.revision
        kept = []
        for area in areas(fence.items):
            flying = not now.landed and self._value("GF_ACTION") > 0.0
            if not allows(area, now.home):
                self._refuse(events.FENCE_WITHOUT_HOME)
            elif flying and not allows(area, place()):
                self._refuse(events.FENCE_WITHOUT_VEHICLE)
            else:
                kept.append(area)
        self._areas = tuple(kept)

    def _refuse(self, why: Definition) -> None:
        self._say(Message.of(Severity.CRITICAL, why))
