"""PX4's navigator: geofence, destination of Return and missions, at 20 Hz in its modes."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from airl_mav.core.addons import entries, load
from airl_mav.core.frames import Geodetic, local_to_geodetic
from airl_mav.vehicle.rotation import Vec
from firmware_sim.autopilot.autopilot_state import OperatorText, Severity
from firmware_sim.autopilot.error_state import P, V
from firmware_sim.autopilot.estimator import Estimator
from firmware_sim.autopilot.events import flight_events as events
from firmware_sim.autopilot.failsafes import failsafe_conditions, watch
from firmware_sim.autopilot.flight_modes import Mode
from firmware_sim.autopilot.guidance import Home
from firmware_sim.autopilot.modes.interface import (
    FlightContext,
    ModeRequest,
    PositionYaw,
    Reposition,
    here,
)
from firmware_sim.autopilot.modes.return_to_launch import return_time_s
from firmware_sim.autopilot.navigation import geofence, plan
from firmware_sim.autopilot.sensor_monitor import NewestSensors
from firmware_sim.autopilot.smooth_trajectory import triple

PERIOD_US = 50_000
"""Period in Mission and Return: 20 Hz [µs]."""

IDLE_US = 100_000
"""Period in other modes [µs]; its reports are read at 10 Hz."""

_LED = (Mode.MISSION, Mode.RETURN)

_WARN = 1
"""Highest GF_ACTION that reports breaches without enforcing the fence."""


class Navigator:
    """Navigator: monitors the fence and runs missions."""

    def __init__(self, plans: plan.Plans, value: Callable[[str], float], crew: plan.Crew) -> None:
        """Store the plans, the look-up for PX4 parameters, and the mission callbacks."""
        self._value, self._crew = value, crew
        self.fence = geofence.FenceMonitor(plans, value, crew.say)
        """Fence monitor."""
        self.missions = plan.Missions()
        """Missions, by an add-on."""
        for place in entries("firmware_sim", "MISSIONS").values():
            self.missions = load(place)(plans, value, crew, self.fence)
        self.due_us = 0
        """Time of the next step [µs]; 0 = immediately."""
        self.idle = False
        """True if steps have no effect until mode, plans, home or parameters change."""
        self._position: Vec | None = None

    def mission_is_valid(self, now: plan.NavigationState | None) -> bool:
        """Return whether the mission is feasible, as required by Mission mode."""
        if now is not None:
            self.missions.review(now)
        return self.missions.valid

    def permitted(
        self, request: ModeRequest | None, now: plan.NavigationState | None
    ) -> ModeRequest | None:
        """Return a request, or None with a text if the geofence forbids the place.

        As in PX4, any place is allowed unless GF_ACTION is stronger than a warning.
        """
        enforced = round(self._value("GF_ACTION")) > _WARN
        if now is None or not enforced or not isinstance(request, Reposition):
            return request
        axes = zip(request.place.position, now.position, strict=True)
        there = [here if math.isnan(axis) else axis for axis, here in axes]
        if self.fence.inside(local_to_geodetic(np.array(there), now.origin), now.home):
            return request
        why = events.ALTITUDE_OUTSIDE if request.altitude_alone else events.REPOSITION_OUTSIDE
        self._crew.say(OperatorText.of(Severity.CRITICAL, why))
        return None

    def return_place(self, now: plan.NavigationState, home: PositionYaw) -> PositionYaw | None:
        """Return the destination of Return; its height is the ground's.

        None if Return flies mission items instead.
        """
        goal = self.missions.destination(now)
        if goal is None:
            return None
        return home if goal == now.home else PositionYaw(now.local(goal), home.yaw)

    def tell(self, context: FlightContext, reports: watch.Reports) -> None:
        """Update the reports to the failsafes."""
        missions = self.missions
        reports.fence = failsafe_conditions.FenceBreach(*self.fence.status.breached)
        reports.mission_missing, reports.mission_finished = not missions.valid, missions.over
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
        self, now: plan.NavigationState, mode: Mode, place: Callable[[], Geodetic], *, armed: bool
    ) -> None:
        """Advance by a period; `place` returns the vehicle's position for the geofence."""
        self.due_us = now.time_us + (PERIOD_US if mode in _LED else IDLE_US)
        self._position = now.position
        self.fence.step(now, mode, place)
        led = mode in _LED or self._value("BAT1_CAPACITY") > 0.0
        self.idle = not (led or self.fence.is_set or any(self.fence.status.breached))
        self.missions.step(now, mode, armed=armed)


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

    def situation(self, *, landed: bool) -> plan.NavigationState | None:
        """Return the flight state for missions; None before the first fix."""
        sample, home, origin = self._sensors.sample, self._home.place, self._estimator.origin
        if sample is None or home is None or origin is None:
            return None
        state = self._estimator.state
        place, velocity = here(state), triple(state, V)
        return plan.NavigationState(
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
