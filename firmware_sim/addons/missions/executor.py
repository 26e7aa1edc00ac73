"""Mission executor: PX4's navigator in Mission mode.

Source of the sequence, conditions and texts: PX4 1.16, MissionBase, Mission and MissionBlock, for a
multicopter. Source of the region of interest: Navigator (vehicle_roi) and
MissionBase::heading_sp_update. It runs at 20 Hz, like PX4's navigator.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from enum import Enum, auto
from functools import partial

from airl_mav.core.frames import Geodetic, wrap_pi
from airl_mav.vehicle.rotation import Vec
from firmware_sim.addons.missions import feasibility, items
from firmware_sim.autopilot.autopilot_state import OperatorText, Severity
from firmware_sim.autopilot.events.definition import Level, MavlinkEvent, define
from firmware_sim.autopilot.navigation import plan

_MODE_LOCATION = 3
"""MAV_ROI_LOCATION."""


class VehicleRoi:
    """Region of interest: a place, or the next waypoint with an offset of the heading."""

    def __init__(self) -> None:
        self._at: Geodetic | float | None = None
        """Place, or offset from the direction of the waypoint [rad]; None = nowhere."""

    def look_at(self, place: Geodetic | None) -> None:
        """Set the region of interest to a place (MAV_CMD_DO_SET_ROI_LOCATION); None = clear it."""
        self._at = place

    def command(self, item: plan.PlanItem) -> None:
        """Execute a mission item about the region of interest; others are ignored."""
        place = Geodetic(item.x, item.y, item.z)
        if item.command == items.NavCommand.DO_SET_ROI_NONE:
            self._at = None
        elif item.command == items.NavCommand.DO_SET_ROI_LOCATION:
            self._at = place
        elif item.command == items.NavCommand.DO_SET_ROI_WPNEXT_OFFSET:
            offset = math.radians(item.z)
            self._at = offset if math.isfinite(offset) else 0.0
        elif item.command == items.NavCommand.DO_SET_ROI:
            located = item.frame != items.PlanFrame.MISSION and item.params[0] == _MODE_LOCATION
            self._at = place if located else None

    def heading(
        self, position: Vec, target: Vec, local: Callable[[Geodetic], Vec], nearest_m: float
    ) -> float | None:
        """Return the heading [rad] to it; None = undefined, or closer than `nearest_m`.

        `position` and the destination `target` are local NED [m]; `local` converts a place to it.
        """
        if self._at is None:
            return None
        offset, there = 0.0, target
        if isinstance(self._at, Geodetic):
            there = local(self._at)
        else:
            offset = self._at
        north, east = there[0] - position[0], there[1] - position[1]
        if math.hypot(north, east) <= nearest_m:
            return None
        return wrap_pi(math.atan2(east, north) + offset)


_N = items.NavCommand
NAN = math.nan

_LOITERS = (_N.LOITER_UNLIM, _N.LOITER_TIME, _N.LOITER_TO_ALT)


MISSION_EXECUTE = define("mission_execute", "Executing Mission")
MISSION_FINISHED = define("mission_finished", "Mission finished, landed")
MISSION_FINISHED_LOITER = define("mission_finished_loiter", "Mission finished, loitering")
_invalid = partial(define, level=Level.ERROR, internal=Level.DISABLED)
MISSION_REFUSED = _invalid(
    "mission_not_valid_refuse", "No valid mission available, refusing takeoff"
)
MISSION_LOITER = _invalid("mission_not_valid_loiter", "No valid mission available, loitering")
MISSION_CLIMB = define(
    "mission_climb_before_start", "Climb to {1:.1m_v} above home", "float mission_init_climb_alt"
)


class _Work(Enum):
    """Preparatory step before the current item."""

    ITEM = auto()
    CLIMB = auto()
    """Climb to the item's altitude at the current position."""
    MOVE_TO_LAND = auto()
    """Fly above the landing place."""


class MissionExecutor:
    """Executor of the mission; `triplet` is the current path."""

    def __init__(
        self,
        plans: plan.Plans,
        value: Callable[[str], float],
        crew: plan.Crew,
        check: Callable[[plan.NavigationState], feasibility.FeasibilityResult],
        *,
        climbs_first: bool = True,
    ) -> None:
        """Store the plans, the look-up for parameters, the crew, and the feasibility check.

        `climbs_first`: climb to the first item's altitude before departure.
        """
        self._plans, self._value, self._crew, self._check = plans, value, crew, check
        self.triplet = items.STANDING
        """Current path."""
        self.cruise_m_s = NAN
        """Speed set by DO_CHANGE_SPEED; NaN = MPC_XY_CRUISE."""
        self.roi = VehicleRoi()
        self._running = False
        self._work = _Work.ITEM
        self._flown = items.FlownItem(_N.WAYPOINT, (0.0, 0.0, 0.0))
        self._arrival = items.Arrival(value)
        self._climbs_first = climbs_first
        self._climb_down = NAN
        """Height NED of the climb before departure; NaN = none."""
        self._began_before = False
        """True if this mission has been flown before."""
        self._disarmed_meanwhile = False
        self._activated_at = 0
        self._speed_to_restore = NAN
        self._versions = (0, 0)
        self._home_altitude_m = NAN
        self._checked_for: object = None

    # --- interface to the autopilot

    def idle(self, situation: plan.NavigationState, *, armed: bool) -> None:
        """Track changes of the plans while another mode flies."""
        if not armed:
            self._disarmed_meanwhile = True
        self._is_changed()
        self.review(situation)

    def activate(self, situation: plan.NavigationState) -> None:
        """Start Mission mode."""
        plans = self._plans
        self._is_changed()
        self._validate(situation)
        over = len(plans.mission) > 0 and plans.current + 1 == len(plans.mission)
        if self._disarmed_meanwhile and self._began_before and over:
            # The mission was completed and the vehicle disarmed: restart from the first item.
            plans.current = 0
            plans.jumps_done.clear()
        self._began_before, self._disarmed_meanwhile = True, False
        self.cruise_m_s = NAN
        self.triplet = items.STANDING
        self._begin(situation.landed)
        self._speed_to_restore = self._speed_before(plans.current)
        self._climb_first(situation)
        self._take_item(situation)
        self._activated_at = plans.current

    def deactivate(self) -> None:
        """Leave Mission mode; the current item restarts when the mission resumes."""
        self._running = False
        self._work = _Work.ITEM

    def update(self, situation: plan.NavigationState) -> None:
        """Advance the mission; call at 20 Hz in Mission mode."""
        if self._is_changed():
            self.review(situation)
            self.triplet = items.STANDING
            self._begin(situation.landed)
            self._take_item(situation)
        self._follow_home(situation)
        if not math.isnan(self._speed_to_restore) and self._plans.current > self._activated_at:
            self.cruise_m_s, self._speed_to_restore = self._speed_to_restore, NAN
        if self._running and self._arrival.is_done(self._flown, self.triplet.target, situation):
            if self._work is not _Work.CLIMB:
                self._plans.reached = self._plans.current
            self._arrival.restart()
            if self._flown.autocontinue:
                self._advance(situation)
        self._turn_to_roi(situation)

    # --- the mission as a whole

    def _is_changed(self) -> bool:
        """Return whether a client has changed the mission or its current item."""
        plans = self._plans
        mission = plans.stored(plan.MissionType.MISSION)
        versions = (mission.revision, plans.set_current_count)
        if versions == self._versions:
            return False
        if mission.revision != self._versions[0]:
            self._began_before = False
        self._versions = versions
        return True

    def review(self, situation: plan.NavigationState) -> None:
        """Check the mission after a change of mission, fence or home."""
        if self._inputs(situation) != self._checked_for:
            self._validate(situation)

    def _inputs(self, situation: plan.NavigationState) -> tuple[object, ...]:
        """Return the inputs of the feasibility check, for comparison."""
        kinds = (plan.MissionType.MISSION, plan.MissionType.FENCE)
        return *(self._plans.stored(kind).revision for kind in kinds), situation.home

    def _validate(self, situation: plan.NavigationState) -> None:
        self._checked_for = self._inputs(situation)
        verdict = self._check(situation)
        for message in verdict.messages:
            self._crew.say(message)
        self._plans.valid = verdict.valid

    def _begin(self, landed: bool) -> None:
        """Start, or report the reason against it."""
        self.roi.look_at(None)
        self._plans.finished = False
        if not self._plans.valid:
            self._running = False
            refused = MISSION_REFUSED if landed else MISSION_LOITER
            self._announce(Severity.CRITICAL, refused.message, refused.event())
            return
        if not self._running:
            self._announce(Severity.INFO, "Executing Mission", MISSION_EXECUTE.event())
        self._running = True
        self._work = _Work.ITEM
        self._plans.reached = -1

    def _climb_first(self, situation: plan.NavigationState) -> None:
        """Determine whether the vehicle must climb before departure."""
        self._climb_down = NAN
        following = items.next_places(self._plans, self._plans.current, 1)
        if self._running and following and self._climbs_first:
            down = self._place(following[0], situation)[2]
            if situation.position[2] - down > self._value("NAV_MC_ALT_RAD"):
                self._climb_down = down

    def _speed_before(self, index: int) -> float:
        """Return the speed set by the items before an index; NaN = none."""
        speeds = [
            item.params[1]
            for item in self._plans.mission[:index]
            if item.command == _N.DO_CHANGE_SPEED
        ]
        return speeds[-1] if speeds and speeds[-1] > 0.0 else NAN

    def _advance(self, situation: plan.NavigationState) -> None:
        """Advance to the next item, or end the mission."""
        if self._work is _Work.ITEM:
            following = items.go_to(self._plans, self._plans.current + 1)
            if following is None:
                landed = situation.landed
                end = MISSION_FINISHED if landed else MISSION_FINISHED_LOITER
                self._announce(Severity.INFO, end.message, end.event())
                if self._plans.current + 1 == len(self._plans.mission):
                    self._plans.jumps_done.clear()
                self._end(situation)
                return
            self._plans.current = following
        self._take_item(situation)

    def _end(self, situation: plan.NavigationState) -> None:
        """Hold position at the end of the mission."""
        self._running = False
        self._plans.finished = True
        triplet = self.triplet
        if situation.landed:
            self.triplet = items.Triplet(items.TripletKind.IDLE, situation.position)
            return
        target = triplet.target if triplet.kind is items.TripletKind.LOITER else situation.position
        self.triplet = items.Triplet(
            items.TripletKind.LOITER, target, yaw=triplet.yaw, acceptance_m=triplet.acceptance_m
        )

    # --- one item

    def _take_item(self, situation: plan.NavigationState) -> None:
        """Set the path for the current item."""
        if not self._running:
            self._end(situation)
            return
        plans = self._plans
        item = plans.mission[plans.current]
        flown = self._flown = items.as_flown(item, self._place(item, situation))
        following = items.next_places(plans, plans.current + 1, 2)
        places = [self._place(place, situation) for place in following]
        work, old = _Work.ITEM, self.triplet
        if item.has_position:
            work, first = self._prepare(item, situation)
            if first is not None:
                places = [first]
            self._set_triplet(flown, situation, places)
        elif item.command == _N.CONDITION_GATE and places:
            target = items.Triplet(
                items.TripletKind.POSITION, places[0], next=places[1] if len(places) > 1 else None
            )
            self.triplet = target._replace(
                acceptance_m=self._arrival.acceptance_m(flown), cruise_m_s=self.cruise_m_s
            )
        if self._work is not _Work.MOVE_TO_LAND and not self.triplet.same_target(old):
            came_from = old.target if old.kind is not items.TripletKind.IDLE else None
            self.triplet = self.triplet._replace(previous=came_from)
        elif self._work is not _Work.MOVE_TO_LAND:
            self.triplet = self.triplet._replace(previous=old.previous)
        self._issue(item, situation)
        self._work = work
        self._arrival.restart()
        self._home_altitude_m = situation.home.altitude_m

    def _prepare(
        self, item: plan.PlanItem, situation: plan.NavigationState
    ) -> tuple[_Work, Vec | None]:
        """Replace the item by a preparatory step if needed; return the item's place after it."""
        flown = self._flown
        north, east, down = situation.position
        if item.command in (_N.TAKEOFF, _N.LAND):
            flown.yaw = NAN
        if not math.isnan(self._climb_down) and self._work is _Work.ITEM:
            above_m = -(self._climb_down - situation.local(situation.home)[2])
            text = f"Climb to {above_m:.1f} meters above home"
            self._announce(Severity.INFO, text, MISSION_CLIMB.event(above_m))
            then = flown.place
            flown.command = _N.TAKEOFF if situation.landed else _N.LOITER_TO_ALT
            flown.place = north, east, self._climb_down
            flown.yaw, flown.stay_s, flown.autocontinue = NAN, 0.0, True
            self._climb_down = NAN
            return _Work.CLIMB, then
        if item.command == _N.TAKEOFF:
            flown.command = _N.WAYPOINT
        away = math.hypot(flown.place[0] - north, flown.place[1] - east)
        far = away > self._value("NAV_ACC_RAD")
        if item.command == _N.LAND and not situation.landed and far and self._work is _Work.ITEM:
            then = flown.place
            level = (
                self.triplet.target[2] if self.triplet.kind is items.TripletKind.POSITION else down
            )
            flown.command, flown.place = _N.WAYPOINT, (then[0], then[1], level)
            flown.stay_s, flown.acceptance_m, flown.autocontinue = 0.0, 0.0, True
            self.triplet = self.triplet._replace(previous=None)
            return _Work.MOVE_TO_LAND, then
        return _Work.ITEM, None

    def _set_triplet(
        self, flown: items.FlownItem, situation: plan.NavigationState, places: list[Vec]
    ) -> None:
        if flown.command in _LOITERS:
            kind = items.TripletKind.LOITER
        elif flown.command == _N.LAND:
            kind = items.TripletKind.LAND
        elif flown.command == _N.TAKEOFF and situation.landed:
            kind = items.TripletKind.TAKEOFF
        else:
            kind = items.TripletKind.POSITION
        # With a stay at the waypoint, the vehicle brakes before it.
        goes_on = flown.autocontinue and flown.stay_s <= 0.0 and bool(places)
        self.triplet = items.Triplet(
            kind,
            flown.place,
            previous=self.triplet.previous,
            next=places[0] if goes_on else None,
            yaw=flown.yaw,
            acceptance_m=self._arrival.acceptance_m(flown),
            precision=flown.precision if kind is items.TripletKind.LAND else 0,
            cruise_m_s=self.cruise_m_s,
        )

    def _place(self, item: plan.PlanItem, situation: plan.NavigationState) -> Vec:
        if not (item.has_position or item.command == _N.CONDITION_GATE):
            return situation.position
        north, east, down = situation.local(item.place(situation.home.altitude_m))
        # An omitted altitude is the current one.
        return north, east, down if math.isfinite(down) else situation.position[2]

    def _follow_home(self, situation: plan.NavigationState) -> None:
        """Shift relative altitudes when home has moved."""
        rise = situation.home.altitude_m - self._home_altitude_m
        self._home_altitude_m = situation.home.altitude_m
        plans = self._plans
        if not rise or math.isnan(rise) or not self._running:
            return
        if plans.mission[plans.current].altitude_is_relative:
            self._flown.place = _raised(self._flown.place, rise)
            triplet = self.triplet
            self.triplet = triplet._replace(
                target=_raised(triplet.target, rise),
                previous=None if triplet.previous is None else _raised(triplet.previous, rise),
                next=None if triplet.next is None else _raised(triplet.next, rise),
            )

    # --- commands

    def _issue(self, item: plan.PlanItem, situation: plan.NavigationState) -> None:
        """Execute an item without a place."""
        command, params = item.command, item.params
        self._arrival.issued(situation.time_us)
        if command == _N.DO_CHANGE_SPEED:
            self.cruise_m_s = params[1] if params[1] > 0.0 else NAN
        elif command == _N.RETURN_TO_LAUNCH:
            # As in PX4, the mission ends before the commander changes the mode.
            if self._plans.has_state and self._plans.current + 1 == len(self._plans.mission):
                self._plans.reached = self._plans.current
                self._advance(situation)
            self._crew.return_to_launch()
        elif command == _N.DO_SET_HOME:
            here = params[0] > 0.5
            place = Geodetic(item.x, item.y, item.z)
            if here or all(math.isfinite(value) for value in place):
                self._crew.set_home(None if here else place)
        else:
            self.roi.command(item)

    def _turn_to_roi(self, situation: plan.NavigationState) -> None:
        """Point the nose to the region of interest, unless the mount does (MIS_MNT_YAW_CTL)."""
        turns = self.triplet.kind in (items.TripletKind.POSITION, items.TripletKind.LOITER)
        if not turns or self._value("MIS_MNT_YAW_CTL") > 0.0:
            return
        yaw = self.roi.heading(
            situation.position, self.triplet.target, situation.local, self._value("NAV_ACC_RAD")
        )
        if yaw is not None:
            self._flown.yaw = yaw
            self.triplet = self.triplet._replace(yaw=yaw)

    def _announce(self, severity: Severity, text: str, event: MavlinkEvent) -> None:
        self._crew.say(OperatorText(severity, text, event))


def _raised(place: Vec, rise_m: float) -> Vec:
    return place[0], place[1], place[2] - rise_m
