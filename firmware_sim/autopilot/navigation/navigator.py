"""Runs what leads the vehicle besides the modes themselves: PX4's navigator, at its 20 Hz."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from airl_mav.core.frames import Geodetic, local_to_geodetic
from airl_mav.vehicle.rotation import Vec
from firmware_sim.autopilot.autopilot_state import Mode
from firmware_sim.autopilot.failsafes.conditions import FenceBreach
from firmware_sim.autopilot.failsafes.watch import Reports
from firmware_sim.autopilot.modes.interface import FlightContext
from firmware_sim.autopilot.navigation.executor import PERIOD_US, Crew, MissionExecutor
from firmware_sim.autopilot.navigation.feasibility import Verdict, check
from firmware_sim.autopilot.navigation.fence_monitor import FenceMonitor
from firmware_sim.autopilot.navigation.flown_item import Situation
from firmware_sim.autopilot.navigation.plan import Plans
from firmware_sim.autopilot.navigation.rally import destination
from firmware_sim.autopilot.navigation.return_path import return_time_s
from firmware_sim.autopilot.navigation.triplet import STANDING, Triplet
from firmware_sim.autopilot.requests import Place


class Navigator:
    """Flies the mission while its mode is on, and watches the fence."""

    def __init__(self, plans: Plans, value: Callable[[str], float], crew: Crew) -> None:
        """Take the plans, a lookup of PX4 parameter names, and who carries out the rest."""
        self._plans, self._value = plans, value
        self.mission = MissionExecutor(plans, value, crew, self._check)
        """Holds the region of interest and the speed, too."""
        self.fence = FenceMonitor(plans, value, crew.say)
        """What of the geofence is breached."""
        self.due_us = 0
        """When to step next [µs]; 0 = at once."""
        self._flying = False
        self._position: Vec | None = None

    @property
    def triplet(self) -> Triplet:
        """What Mission mode flies."""
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

    def return_place(self, situation: Situation, home: Place) -> Place:
        """Return where Return goes: home, or what RTL_TYPE prefers; its height is the ground's."""
        here = local_to_geodetic(np.array(situation.position), situation.origin)
        goal = destination(self._plans, situation.home, here, round(self._value("RTL_TYPE")))
        return home if goal == situation.home else Place(situation.local(goal), home.yaw)

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
        goal = context.home if context.return_place is None else context.return_place().position
        away, height = math.dist(position[:2], goal[:2]), goal[2] - position[2]
        return return_time_s(self._value, height, away)

    def step(
        self, situation: Situation, mode: Mode, place: Callable[[], Geodetic], *, armed: bool
    ) -> None:
        """Advance by a period; `place` is where the vehicle is, for the geofence."""
        self.due_us = situation.time_us + PERIOD_US
        self._position = situation.position
        self.fence.step(situation, mode, place)
        flying = armed and mode is Mode.MISSION
        if flying and not self._flying:
            self.mission.activate(situation)
        elif self._flying and not flying:
            self.mission.deactivate()
        elif flying:
            self.mission.update(situation)
        else:
            self.mission.idle(situation, armed=armed)
        self._flying = flying

    def _check(self, situation: Situation) -> Verdict:
        return check(
            self._plans.mission,
            situation.home,
            self._value,
            landed=situation.landed,
            inside_fence=lambda place: self.fence.inside(place, situation.home),
        )
