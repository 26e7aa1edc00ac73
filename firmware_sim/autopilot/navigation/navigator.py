"""PX4's navigator: missions, geofence and the way home, at 20 Hz while it leads the vehicle."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from airl_mav.core.frames import Geodetic, local_to_geodetic
from airl_mav.vehicle.rotation import Vec
from firmware_sim.autopilot.autopilot_state import Message, Mode, Severity
from firmware_sim.autopilot.events import command_events
from firmware_sim.autopilot.events import flight_events as events
from firmware_sim.autopilot.failsafes.conditions import FenceBreach
from firmware_sim.autopilot.failsafes.watch import Reports
from firmware_sim.autopilot.modes.interface import FlightContext
from firmware_sim.autopilot.navigation.executor import PERIOD_US, Crew, MissionExecutor
from firmware_sim.autopilot.navigation.feasibility import Verdict, check
from firmware_sim.autopilot.navigation.fence import FenceMonitor
from firmware_sim.autopilot.navigation.flown_item import Situation
from firmware_sim.autopilot.navigation.plan import Kind, PlanItem, Plans, distance_m
from firmware_sim.autopilot.navigation.return_path import return_height, return_time_s
from firmware_sim.autopilot.navigation.triplet import STANDING, Triplet
from firmware_sim.autopilot.navigation.way_home import (
    Destination,
    ReturnType,
    along_mission,
    climb,
    destination,
    landing_start,
    onwards,
)
from firmware_sim.autopilot.requests import Place, Reposition, Request

IDLE_US = 100_000
"""Period in modes that it does not lead: what it reports then is read at 10 Hz."""

_LED = (Mode.MISSION, Mode.RETURN)

_WARN = 1
"""GF_ACTION: up to here the fence is told of, and not kept."""


class Navigator:
    """Flies the mission while its mode is on, and watches the fence."""

    def __init__(self, plans: Plans, value: Callable[[str], float], crew: Crew) -> None:
        """Take the plans, a lookup of PX4 parameter names, and who carries out the rest."""
        self._plans, self._value = plans, value
        self.mission = MissionExecutor(plans, value, crew, self._check)
        """Holds the region of interest and the speed, too."""
        self._way_home = Plans()
        """What Return flies of the mission."""
        self._returning = MissionExecutor(
            self._way_home, value, crew, self._check_way_home, climbs_first=False
        )
        self._home_by_mission = False
        """Whether Return flies along the mission now."""
        self.fence = FenceMonitor(plans, value, crew.say)
        """What of the geofence is breached."""
        self.due_us = 0
        """When to step next [µs]; 0 = at once."""
        self.idle = False
        """Whether steps change nothing as long as mode, plans, home and parameters stay."""
        self._crew = crew
        self._returned = False
        """Whether the way of the present return has been chosen."""
        self._flying = False
        self._position: Vec | None = None

    @property
    def triplet(self) -> Triplet:
        """What is flown of a mission, in Mission or Return mode."""
        if self._home_by_mission:
            return self._returning.triplet
        return self.mission.triplet if self._flying else STANDING

    @property
    def mission_over(self) -> bool:
        """Whether the mission has come to its end."""
        return self._flying and self.mission.finished

    def mission_is_valid(self, situation: Situation | None) -> bool:
        """Return whether Mission mode has what it needs."""
        if situation is not None:
            self.mission.review(situation)
        return self.mission.valid

    def permitted(self, request: Request | None, now: Situation | None) -> Request | None:
        """Return a request; None where the geofence forbids the place, which is said.

        As PX4: with a GF_ACTION that does no more than warn, any place is allowed.
        """
        kept = round(self._value("GF_ACTION")) > _WARN
        if now is None or not kept or not isinstance(request, Reposition):
            return request
        wanted = zip(request.place.position, now.position, strict=True)
        there = [here if math.isnan(axis) else axis for axis, here in wanted]
        if self.fence.inside(local_to_geodetic(np.array(there), now.origin), now.home):
            return request
        height, place = command_events.ALTITUDE_OUTSIDE, command_events.REPOSITION_OUTSIDE
        why = height if request.altitude_alone else place
        self._crew.say(Message.of(Severity.CRITICAL, why))
        return None

    def return_place(self, situation: Situation, home: Place) -> Place | None:
        """Return where Return goes: home, or what RTL_TYPE prefers; its height is the ground's.

        None where it flies items of the mission, which lead it there.
        """
        if self._return_type is ReturnType.MISSION:
            return None
        goal = self._destination(situation)
        if goal.by_landing:
            return None
        same = goal.place == situation.home
        return home if same else Place(situation.local(goal.place), home.yaw)

    @property
    def _return_type(self) -> ReturnType:
        asked = round(self._value("RTL_TYPE"))
        return ReturnType(asked) if asked in set(ReturnType) else ReturnType.HOME_OR_RALLY

    def _destination(self, situation: Situation) -> Destination:
        here = local_to_geodetic(np.array(situation.position), situation.origin)
        kind, valid = self._return_type, self.mission.valid
        return destination(self._plans, situation.home, here, kind, valid=valid)

    def _plan_way_home(self, situation: Situation, *, flying: bool) -> None:
        """Find the items that Return flies; `flying`: whether a mission was flown until now."""
        plans, home = self._plans, situation.home
        here = local_to_geodetic(np.array(situation.position), situation.origin)
        if self._return_type is ReturnType.MISSION:
            way = along_mission(plans, home, here, flying=flying) if self.mission.valid else ()
        else:
            way = self._way_to_landing(situation, here)
        self._way_home.store(Kind.MISSION, way, 0, 0)

    def _way_to_landing(self, situation: Situation, here: Geodetic) -> tuple[PlanItem, ...]:
        """Return the climb, and the mission's landing from its beginning."""
        begin = landing_start(self._plans.mission)
        if begin is None:
            return ()
        ground = self._destination(situation).place
        away = distance_m(ground[:2], here[:2])
        above = return_height(self._value, here.altitude_m - ground.altitude_m, away)
        landing = onwards(self._plans, begin)
        altitude = ground.altitude_m + above
        if altitude <= here.altitude_m:
            return landing
        text = f"RTL Mission land: climb to {math.ceil(altitude)} m"
        event = events.RTL_MISSION_LAND.event(math.ceil(altitude))
        self._crew.say(Message(Severity.INFO, text, event))
        return (climb(here, altitude), *landing)

    def _check_way_home(self, _situation: Situation) -> Verdict:
        return Verdict(bool(self._way_home.mission), ())

    def tell(self, context: FlightContext, reports: Reports) -> None:
        """Tell the modes what to fly, and the failsafes what is wrong."""
        context.triplet, context.mission_over = self.triplet, self.mission_over
        reports.fence = FenceBreach(*self.fence.status.breached)
        reports.mission_missing = not self.mission.valid
        reports.mission_finished = self.mission_over
        if self._value("BAT1_CAPACITY") > 0.0 and self._position is not None:
            reports.return_time_s = self._return_time_s(context, self._position)

    def _return_time_s(self, context: FlightContext, position: Vec) -> float:
        """Return how long a return from a place, local NED [m], takes [s]."""
        place = None if context.return_place is None else context.return_place()
        if place is None:
            return 0.0  # along a mission nobody knows
        goal = place.position
        away, height = math.dist(position[:2], goal[:2]), goal[2] - position[2]
        return return_time_s(self._value, height, away)

    def step(
        self, situation: Situation, mode: Mode, place: Callable[[], Geodetic], *, armed: bool
    ) -> None:
        """Advance by a period; `place` is where the vehicle is, for the geofence."""
        self.due_us = situation.time_us + (PERIOD_US if mode in _LED else IDLE_US)
        self._position = situation.position
        self.fence.step(situation, mode, place)
        led = mode in _LED or self._value("BAT1_CAPACITY") > 0.0
        self.idle = not (led or self.fence.is_set or any(self.fence.status.breached))
        flying = armed and mode is Mode.MISSION
        self._step_home(situation, returning=armed and mode is Mode.RETURN)
        if flying and not self._flying:
            self.mission.activate(situation)
        elif self._flying and not flying:
            self.mission.deactivate()
        elif flying:
            self.mission.update(situation)
        else:
            self.mission.idle(situation, armed=armed)
        self._flying = flying

    def _step_home(self, situation: Situation, *, returning: bool) -> None:
        """Advance along the mission where Return flies it."""
        if not returning:
            if self._home_by_mission:
                self._returning.deactivate()
            self._home_by_mission = self._returned = False
        elif self._home_by_mission:
            self._returning.update(situation)
        elif not self._returned:
            # The way is chosen once, when the mode begins.
            self._returned = True
            anywhere = Place((0.0, 0.0, 0.0), 0.0)
            if self.return_place(situation, anywhere) is None:
                self._plan_way_home(situation, flying=self._flying)
                self._home_by_mission = True
                self._returning.activate(situation)

    def _check(self, situation: Situation) -> Verdict:
        return check(
            self._plans.mission,
            situation.home,
            self._value,
            landed=situation.landed,
            inside_fence=lambda place: self.fence.inside(place, situation.home),
        )
