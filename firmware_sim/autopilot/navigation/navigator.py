"""PX4's navigator: missions, geofence and return path, at 20 Hz in its modes."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from airl_mav.core.frames import Geodetic, local_to_geodetic
from airl_mav.vehicle.rotation import Vec
from firmware_sim.autopilot.autopilot_state import OperatorText, Severity
from firmware_sim.autopilot.error_state import P, V
from firmware_sim.autopilot.estimator import Estimator
from firmware_sim.autopilot.events import flight_events
from firmware_sim.autopilot.events import flight_events as events
from firmware_sim.autopilot.failsafes.failsafe_conditions import FenceBreach
from firmware_sim.autopilot.failsafes.watch import Reports
from firmware_sim.autopilot.flight_modes import Mode
from firmware_sim.autopilot.guidance import Home
from firmware_sim.autopilot.inputs import ModeRequest, PositionYaw, Reposition
from firmware_sim.autopilot.modes.interface import FlightContext, here, triple
from firmware_sim.autopilot.modes.return_to_launch import return_height, return_time_s
from firmware_sim.autopilot.navigation.executor import PERIOD_US, Crew, MissionExecutor
from firmware_sim.autopilot.navigation.feasibility import FeasibilityResult, check
from firmware_sim.autopilot.navigation.fence import FenceMonitor
from firmware_sim.autopilot.navigation.flown_item import ExecutorState
from firmware_sim.autopilot.navigation.plan import (
    STANDING,
    MissionType,
    PlanItem,
    Plans,
    Triplet,
    distance_m,
)
from firmware_sim.autopilot.navigation.way_home import (
    Destination,
    ReturnType,
    along_mission,
    climb,
    destination,
    landing_start,
    onwards,
)
from firmware_sim.autopilot.sensor_monitor import NewestSensors

IDLE_US = 100_000
"""Period in other modes [µs]; its reports are read at 10 Hz."""

_LED = (Mode.MISSION, Mode.RETURN)

_WARN = 1
"""Highest GF_ACTION that reports breaches without enforcing the fence."""


class Navigator:
    """Navigator: runs the mission in its mode, and monitors the fence."""

    def __init__(self, plans: Plans, value: Callable[[str], float], crew: Crew) -> None:
        """Store the plans, the look-up for PX4 parameters, and the mission callbacks."""
        self._plans, self._value = plans, value
        self.mission = MissionExecutor(plans, value, crew, self._check)
        """Mission executor, which also holds region of interest and speed."""
        self._way_home = Plans()
        """Mission items flown by Return."""
        self._returning = MissionExecutor(
            self._way_home, value, crew, self._check_way_home, climbs_first=False
        )
        self._home_by_mission = False
        """True if Return flies mission items now."""
        self.fence = FenceMonitor(plans, value, crew.say)
        """Fence monitor."""
        self.due_us = 0
        """Time of the next step [µs]; 0 = immediately."""
        self.idle = False
        """True if steps have no effect until mode, plans, home or parameters change."""
        self._crew = crew
        self._returned = False
        """True if the path of the current return has been selected."""
        self._flying = False
        self._position: Vec | None = None

    @property
    def triplet(self) -> Triplet:
        """Active waypoints in Mission or Return mode."""
        if self._home_by_mission:
            return self._returning.triplet
        return self.mission.triplet if self._flying else STANDING

    @property
    def mission_over(self) -> bool:
        """True if the mission has ended."""
        return self._flying and self.mission.finished

    def mission_is_valid(self, situation: ExecutorState | None) -> bool:
        """Return whether the mission is feasible, as required by Mission mode."""
        if situation is not None:
            self.mission.review(situation)
        return self.mission.valid

    def permitted(
        self, request: ModeRequest | None, now: ExecutorState | None
    ) -> ModeRequest | None:
        """Return a request, or None with a text if the geofence forbids the place.

        As in PX4, any place is allowed unless GF_ACTION is stronger than a warning.
        """
        kept = round(self._value("GF_ACTION")) > _WARN
        if now is None or not kept or not isinstance(request, Reposition):
            return request
        wanted = zip(request.place.position, now.position, strict=True)
        there = [here if math.isnan(axis) else axis for axis, here in wanted]
        if self.fence.inside(local_to_geodetic(np.array(there), now.origin), now.home):
            return request
        height, place = flight_events.ALTITUDE_OUTSIDE, flight_events.REPOSITION_OUTSIDE
        why = height if request.altitude_alone else place
        self._crew.say(OperatorText.of(Severity.CRITICAL, why))
        return None

    def return_place(self, situation: ExecutorState, home: PositionYaw) -> PositionYaw | None:
        """Return the destination of Return by RTL_TYPE; its height is the ground's.

        None if Return flies mission items instead.
        """
        if self._return_type is ReturnType.MISSION:
            return None
        goal = self._destination(situation)
        if goal.by_landing:
            return None
        same = goal.place == situation.home
        return home if same else PositionYaw(situation.local(goal.place), home.yaw)

    @property
    def _return_type(self) -> ReturnType:
        asked = round(self._value("RTL_TYPE"))
        return ReturnType(asked) if asked in set(ReturnType) else ReturnType.HOME_OR_RALLY

    def _destination(self, situation: ExecutorState) -> Destination:
        here = local_to_geodetic(np.array(situation.position), situation.origin)
        kind, valid = self._return_type, self.mission.valid
        return destination(self._plans, situation.home, here, kind, valid=valid)

    def _plan_way_home(self, situation: ExecutorState, *, flying: bool) -> None:
        """Store the items for Return; `flying`: a mission was active until now."""
        plans, home = self._plans, situation.home
        here = local_to_geodetic(np.array(situation.position), situation.origin)
        if self._return_type is ReturnType.MISSION:
            way = along_mission(plans, home, here, flying=flying) if self.mission.valid else ()
        else:
            way = self._way_to_landing(situation, here)
        self._way_home.store(MissionType.MISSION, way, 0, 0)

    def _way_to_landing(self, situation: ExecutorState, here: Geodetic) -> tuple[PlanItem, ...]:
        """Return the climb and the complete landing of the mission."""
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
        self._crew.say(OperatorText(Severity.INFO, text, event))
        return (climb(here, altitude), *landing)

    def _check_way_home(self, _situation: ExecutorState) -> FeasibilityResult:
        return FeasibilityResult(bool(self._way_home.mission), ())

    def tell(self, context: FlightContext, reports: Reports) -> None:
        """Update the paths of the modes and the reports to the failsafes."""
        context.triplet, context.mission_over = self.triplet, self.mission_over
        reports.fence = FenceBreach(*self.fence.status.breached)
        reports.mission_missing = not self.mission.valid
        reports.mission_finished = self.mission_over
        if self._value("BAT1_CAPACITY") > 0.0 and self._position is not None:
            reports.return_time_s = self._return_time_s(context, self._position)

    def _return_time_s(self, context: FlightContext, position: Vec) -> float:
        """Return the duration of a return from a place, local NED [m], in seconds."""
        place = None if context.return_place is None else context.return_place()
        if place is None:
            return 0.0  # unknown along a mission
        goal = place.position
        away, height = math.dist(position[:2], goal[:2]), goal[2] - position[2]
        return return_time_s(self._value, height, away)

    def step(
        self, situation: ExecutorState, mode: Mode, place: Callable[[], Geodetic], *, armed: bool
    ) -> None:
        """Advance by a period; `place` returns the vehicle's position for the geofence."""
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

    def _step_home(self, situation: ExecutorState, *, returning: bool) -> None:
        """Advance Return along the mission, if it flies mission items."""
        if not returning:
            if self._home_by_mission:
                self._returning.deactivate()
            self._home_by_mission = self._returned = False
        elif self._home_by_mission:
            self._returning.update(situation)
        elif not self._returned:
            # The path is selected once, at the start of the mode.
            self._returned = True
            anywhere = PositionYaw((0.0, 0.0, 0.0), 0.0)
            if self.return_place(situation, anywhere) is None:
                self._plan_way_home(situation, flying=self._flying)
                self._home_by_mission = True
                self._returning.activate(situation)

    def _check(self, situation: ExecutorState) -> FeasibilityResult:
        return check(
            self._plans.mission,
            situation.home,
            self._value,
            landed=situation.landed,
            inside_fence=lambda place: self.fence.inside(place, situation.home),
        )


class Whereabouts:
    """Vehicle position from estimator, sensors and home."""

    def __init__(
        self,
        estimator: Estimator,
        sensors: NewestSensors,
        home: Home,
        value: Callable[[str], float],
    ) -> None:
        """Store the sources and the look-up for PX4 parameters."""
        self._estimator, self._sensors, self._home = estimator, sensors, home
        self._value = value

    def situation(self, *, landed: bool) -> ExecutorState | None:
        """Return the flight state for missions; None before the first fix."""
        sample, home, origin = self._sensors.sample, self._home.place, self._estimator.origin
        if sample is None or home is None or origin is None:
            return None
        state = self._estimator.state
        place, velocity = here(state), triple(state, V)
        return ExecutorState(
            sample.time_us, place.position, place.yaw, landed, home, origin, velocity
        )

    def fenced_place(self) -> Geodetic:
        """Return the position selected by GF_SOURCE: the estimate, or GPS.

        Raises RuntimeError before the first fix.
        """
        origin, gps = self._estimator.origin, self._sensors.gps
        if gps is not None and (self._value("GF_SOURCE") > 0.0 or origin is None):
            return gps.position
        if origin is None:
            raise RuntimeError("no fix yet: the vehicle is nowhere on the globe")
        return local_to_geodetic(self._estimator.state[P:V], origin)
