"""A mission item by item, on a vehicle that is moved by hand."""

from __future__ import annotations

import math

import pytest

from airl_mav.core.frames import Geodetic
from firmware_sim.addons.missions.items import NavCommand, PlanFrame, TripletKind
from firmware_sim.autopilot.flight_modes import Mode
from firmware_sim.autopilot.navigation.plan import MissionType, PlanItem
from firmware_sim.autopilot.snapshot import progress
from tests.support.mission_kit import NAN, ORIGIN, FakeFlight, at, do, place

N = NavCommand


def flying(*items: PlanItem, **parameters: float) -> FakeFlight:
    """Return a flight at 10 m that has begun its mission."""
    flight = FakeFlight(*items, parameters=parameters)
    flight.now = flight.now._replace(position=(0.0, 0.0, -10.0), landed=False)
    flight.start()
    return flight


def kind(flight: FakeFlight) -> TripletKind:
    return flight.executor.triplet.kind


def target(flight: FakeFlight) -> tuple[float, ...]:
    return tuple(round(c, 1) + 0.0 for c in flight.executor.triplet.target)


def test_from_the_ground_it_climbs_first_then_goes_to_the_waypoint() -> None:
    flight = FakeFlight(at(0, 0, 5, N.TAKEOFF), at(20, 10, 8))
    flight.start()
    assert kind(flight) is TripletKind.TAKEOFF
    assert flight.texts == ["Executing Mission", "Climb to 5.0 meters above home"]
    # Take-off needs its height alone; it is not the item yet, and not reported.
    flight.be((3.0, 0.0, -4.3))
    assert target(flight) == (0.0, 0.0, -5.0)
    assert flight.plans.reached == -1
    assert flight.plans.current == 0
    flight.arrive()
    assert (flight.plans.reached, flight.plans.current) == (0, 1)
    assert target(flight) == (20.0, 10.0, -8.0)
    assert kind(flight) is TripletKind.POSITION


def test_it_is_near_enough_within_the_radius_and_height() -> None:
    flight = flying(at(20, 0, 10), at(40, 0, 10))
    flight.be((17.9, 0.0, -10.0))
    assert flight.plans.reached == -1
    flight.be((18.1, 0.0, -9.1))  # 0.9 m too low: NAV_MC_ALT_RAD is 0.8 m
    assert flight.plans.reached == -1
    flight.be((18.1, 0.0, -9.3))
    assert flight.plans.reached == 0
    tight = flying(at(20, 0, 10, N.WAYPOINT, 0, 0.5), at(40, 0, 10))
    tight.be((19.4, 0.0, -10.0))
    assert tight.plans.reached == -1
    tight.be((19.6, 0.0, -10.0))
    assert tight.plans.reached == 0


@pytest.mark.parametrize("command", [N.WAYPOINT, N.LOITER_TIME])
def test_it_stays_for_a_time(command: int) -> None:
    flight = flying(at(20, 0, 10, command, 3.0), at(40, 0, 10))
    assert flight.executor.triplet.next is None  # it brakes before the waypoint
    flight.arrive()
    flight.be(seconds=2.8)
    assert flight.plans.reached == -1
    flight.be(seconds=0.3)
    assert flight.plans.current == 1


def test_a_heading_must_be_reached_unless_there_is_a_timeout() -> None:
    items = at(20, 0, 10, N.WAYPOINT, 0, 0, 0, 90), at(40, 0, 10)
    flight = flying(*items)
    flight.be((20.0, 0.0, -10.0), yaw=math.radians(77))
    assert flight.plans.reached == -1
    flight.be(yaw=math.radians(79))
    assert flight.plans.reached == 0
    hasty = flying(*items, MIS_YAW_TMT=2.0)
    hasty.be((20.0, 0.0, -10.0), yaw=0.0)
    assert hasty.plans.reached == 0


def test_the_triplet_has_what_was_and_what_comes() -> None:
    flight = flying(at(20, 0, 10), do(N.DO_CHANGE_SPEED, 1, 3), at(20, 20, 10), at(0, 20, 10))
    assert flight.executor.triplet.previous is None
    assert flight.executor.triplet.next == pytest.approx((20, 20, -10), abs=1e-3)
    assert math.isnan(flight.executor.triplet.cruise_m_s)
    flight.arrive()
    flight.be()
    triplet = flight.executor.triplet
    assert triplet.previous == pytest.approx((20, 0, -10), abs=1e-3)
    assert triplet.next == pytest.approx((0, 20, -10), abs=1e-3)
    assert triplet.cruise_m_s == 3.0


def test_the_end_is_hold() -> None:
    flight = flying(at(20, 0, 10))
    flight.arrive()
    assert flight.plans.finished
    assert flight.texts[-1] == "Mission finished, loitering"
    assert kind(flight) is TripletKind.LOITER


def test_landing_is_over_its_place_first_and_ends_on_the_ground() -> None:
    flight = flying(at(20, 0, 10), at(20, 30, 0, N.LAND))
    flight.arrive()
    assert target(flight) == (20.0, 30.0, -10.0)  # at the height of before
    assert kind(flight) is TripletKind.POSITION
    flight.arrive()
    assert kind(flight) is TripletKind.LAND
    flight.be((20.0, 30.0, 0.0), landed=True)
    assert flight.texts[-1] == "Mission finished, landed"
    assert kind(flight) is TripletKind.IDLE


def test_jumps_are_counted_and_counted_anew_after_the_end() -> None:
    flight = flying(at(20, 0, 10), at(20, 20, 10), do(N.DO_JUMP, 0, 2), at(0, 0, 10))
    order = []
    for _ in range(7):
        order.append(flight.plans.current)
        flight.arrive()
    assert order == [0, 1, 0, 1, 0, 1, 3]
    assert flight.plans.finished
    assert flight.plans.jumps_done == {}
    # Interrupted, the count stays.
    flight = flying(at(20, 0, 10), do(N.DO_JUMP, 0, 5), at(0, 0, 10))
    flight.arrive()
    flight.arrive()
    flight.executor.deactivate()
    flight.start()
    assert flight.plans.jumps_done == {1: 2}


@pytest.mark.parametrize("target_index", [-1.0, 2.0, 1e9, NAN])
def test_a_jump_out_of_the_mission_ends_it(target_index: float) -> None:
    flight = flying(at(20, 0, 10), do(N.DO_JUMP, target_index, 1))
    flight.arrive()
    assert flight.plans.finished


def test_jumps_in_a_circle_end() -> None:
    flight = flying(at(20, 0, 10), do(N.DO_JUMP, 2, 99), do(N.DO_JUMP, 1, 99), at(0, 0, 10))
    flight.arrive()
    assert flight.plans.jumps_done == {1: 5, 2: 5}


def test_pause_and_resume_go_on_with_the_item() -> None:
    flight = flying(at(20, 0, 10), do(N.DO_CHANGE_SPEED, 1, 3), at(40, 0, 10), at(60, 0, 10))
    flight.arrive()
    flight.be()
    assert flight.plans.current == 2
    reached = flight.plans.reached
    flight.executor.deactivate()
    assert flight.plans.reached == reached >= 0
    flight.executor.idle(flight.now, armed=True)
    flight.start()
    assert (flight.plans.current, flight.plans.reached) == (2, -1)
    assert target(flight) == (40.0, 0.0, -10.0)
    # The speed of before comes back with the next item, as in PX4.
    assert math.isnan(flight.executor.triplet.cruise_m_s)
    flight.arrive()
    flight.be()
    assert flight.executor.cruise_m_s == 3.0


def test_flown_to_its_end_it_begins_anew_once_disarmed() -> None:
    flight = flying(at(20, 0, 10), at(0, 0, 10))
    flight.arrive()
    flight.arrive()
    flight.executor.deactivate()
    flight.start()
    assert flight.plans.current == 1
    flight.executor.deactivate()
    flight.executor.idle(flight.now, armed=False)
    flight.start()
    assert flight.plans.current == 0


@pytest.mark.parametrize("has_state", [False, True])
def test_a_return_ends_the_mission(has_state: bool) -> None:
    """Up to PX4 1.16 clients read the end of the mission from the item before the return."""
    flight = flying(at(20, 0, 10), at(40, 0, 10), do(N.RETURN_TO_LAUNCH))
    flight.plans.has_state = has_state
    flight.arrive()
    flight.arrive()
    assert flight.plans.current == 2 and flight.plans.finished is has_state
    assert ("Mission finished, loitering" in flight.texts) is has_state
    flight.executor.deactivate()
    flight.executor.idle(flight.now, armed=False)
    assert flight.plans.reached == (2 if has_state else 1)
    state = progress(flight.plans, Mode.RETURN).state.name
    assert state == ("COMPLETE" if has_state else "UNKNOWN")


def test_the_state_of_the_mission_is_reported() -> None:
    def state(mode: Mode) -> tuple[str, int]:
        found = progress(flight.plans, mode)
        return found.state.name, found.mode

    flight = FakeFlight(at(20, 0, 10), at(40, 0, 10))
    assert state(Mode.HOLD) == ("NO_MISSION", 2)  # not yet checked
    flight.executor.idle(flight.now, armed=False)
    assert state(Mode.HOLD) == ("NOT_STARTED", 2)
    flight.now = flight.now._replace(position=(0.0, 0.0, -10.0), landed=False)
    flight.start()
    assert state(Mode.MISSION) == ("ACTIVE", 1)
    flight.arrive()
    assert state(Mode.RETURN) == ("PAUSED", 2)
    flight.arrive()
    assert state(Mode.MISSION) == ("COMPLETE", 1)
    flight.executor.deactivate()
    assert state(Mode.HOLD) == ("COMPLETE", 2)
    flight.start()
    flight.plans.clear(MissionType.MISSION)
    flight.executor.idle(flight.now, armed=True)
    assert state(Mode.HOLD) == ("NO_MISSION", 2)


def test_set_current_and_a_new_mission_are_flown_at_once() -> None:
    flight = flying(at(20, 0, 10), at(40, 0, 10), at(60, 0, 10))
    flight.plans.set_current(2)
    flight.be()
    assert target(flight) == (60.0, 0.0, -10.0)
    assert flight.executor.triplet.previous is None
    flight.plans.store(MissionType.MISSION, (at(0, 50, 10), at(0, 0, 10)), 2, 0)
    flight.be()
    assert target(flight) == (0.0, 50.0, -10.0)
    flight.plans.clear(MissionType.MISSION)
    flight.be()
    assert flight.texts[-1] == "No valid mission available, loitering"
    assert flight.plans.finished


def test_without_a_mission_it_does_not_take_off() -> None:
    flight = FakeFlight()
    flight.start()
    assert flight.texts[-1] == "No valid mission available, refusing takeoff"
    assert kind(flight) is TripletKind.IDLE


def test_items_without_a_place() -> None:
    flight = flying(
        do(N.IMAGE_START_CAPTURE, 0, 1),
        do(N.SET_CAMERA_MODE, 0, 1),
        do(N.DO_GIMBAL_MANAGER_PITCHYAW, -30, 0),
        do(N.DO_SET_HOME, 1),
        do(N.DO_SET_HOME, 0, x=47.0, y=8.0, z=500.0),
        do(N.DELAY, 1.0),
        at(20, 0, 10, N.CONDITION_GATE),
        at(40, 0, 10),
        do(N.RETURN_TO_LAUNCH),
        MIS_COMMAND_TOUT=0.5,
    )
    flight.be(seconds=0.1)
    assert flight.plans.current == 2
    flight.be(seconds=0.7)
    assert flight.homes == [None, Geodetic(47.0, 8.0, 500.0)]
    assert flight.plans.current == 5
    flight.be(seconds=1.1)
    assert flight.plans.current == 6
    # The gate is passed anywhere beyond it, and led to the next waypoint all the while.
    assert target(flight) == (40.0, 0.0, -10.0)
    flight.be((19.0, 30.0, -10.0))
    assert flight.plans.current == 6
    flight.be((21.0, 30.0, -10.0))
    assert flight.plans.current == 7
    flight.arrive()
    flight.be()
    assert flight.returned


def test_loiter_unlimited_and_no_autocontinue_stay() -> None:
    for item in (at(20, 0, 10, N.LOITER_UNLIM), at(20, 0, 10, autocontinue=False)):
        flight = flying(item, at(40, 0, 10))
        flight.arrive()
        flight.be(seconds=20.0)
        assert flight.plans.current == 0


def test_altitudes_above_sea_and_home_that_moves() -> None:
    sea = at(20, 0, ORIGIN.altitude_m + 15.0, frame=PlanFrame.GLOBAL_INT)
    assert target(flying(sea, at(0, 0, 10))) == (0.0, 0.0, -15.0)  # the climb to it
    flight = flying(at(20, 0, 10), at(40, 0, 10))
    home = flight.now.home
    flight.now = flight.now._replace(home=home._replace(altitude_m=home.altitude_m + 2.0))
    flight.be((0.0, 0.0, -10.0))
    assert target(flight) == (20.0, 0.0, -12.0)


@pytest.mark.parametrize("up", [NAN, math.inf])
def test_an_altitude_that_is_no_number_is_the_present_one(up: float) -> None:
    flight = flying(at(20, 0, up, N.WAYPOINT, math.inf, math.inf), at(40, 0, 10))
    assert target(flight) == (20.0, 0.0, -10.0)
    flight.arrive()
    assert flight.plans.current == 1


@pytest.mark.parametrize("mount_turns", [0.0, 1.0])
def test_region_of_interest(mount_turns: float) -> None:
    looked_at = place(0.0, 50.0)
    roi = PlanItem(
        N.DO_SET_ROI_LOCATION, PlanFrame.GLOBAL_INT, (0, 0, 0, 0), *looked_at[:2], looked_at[2]
    )
    flight = flying(
        roi, at(0, 0, 10), at(0, -30, 10), do(N.DO_SET_ROI_NONE), at(0, 0, 10),
        MIS_MNT_YAW_CTL=mount_turns,
    )  # fmt: skip
    flight.be((0.0, 0.0, -10.0), yaw=math.pi / 2)
    flight.be((0.0, -10.0, -10.0))
    if mount_turns:
        assert math.isnan(flight.executor.triplet.yaw)
        return
    assert flight.executor.triplet.yaw == pytest.approx(math.pi / 2, abs=1e-3)
    flight.be((40.0, 50.0, -10.0))
    assert abs(flight.executor.triplet.yaw) == pytest.approx(math.pi, abs=1e-3)
    flight.be((0.0, 0.0, -10.0), yaw=math.pi / 2)
    flight.be((0.0, -30.0, -10.0), yaw=math.pi / 2)
    flight.be()
    flight.be()
    assert math.isnan(flight.executor.triplet.yaw)
