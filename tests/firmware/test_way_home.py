"""Return along the mission: which items it takes, and how it is flown."""

from __future__ import annotations

import math

import pytest

from firmware_sim.addons.missions.items import NavCommand
from firmware_sim.addons.missions.manager import along_mission, landing_start, onwards
from firmware_sim.autopilot.autopilot_state import Result
from firmware_sim.autopilot.commander import FlightPhase
from firmware_sim.autopilot.flight_modes import Mode
from firmware_sim.autopilot.navigation.plan import MissionType, PlanItem, Plans
from tests.support.flight_rig import Rig
from tests.support.mission_kit import ORIGIN, at, do, place

_N = NavCommand

TAKE_OFF = at(0, 0, 5, _N.TAKEOFF)
OUT = (TAKE_OFF, at(20, 0, 6), at(20, 20, 8, _N.LOITER_TIME, 30.0), at(0, 20, 7))
LANDING = (do(_N.DO_LAND_START), at(-10, 20, 9), at(-10, 0, 0, _N.LAND))


def plans(*items: PlanItem, current: int = 0) -> Plans:
    stored = Plans()
    stored.store(MissionType.MISSION, items, 1, current)
    return stored


def places(way: tuple[PlanItem, ...]) -> list[tuple[int, float, float]]:
    """Return command, latitude and longitude of each item."""
    return [(item.command, item.x, item.y) for item in way]


def expected(*found: tuple[int, float, float]) -> list[tuple[int, float, float]]:
    return [(command, *place(north, east)[:2]) for command, north, east in found]


def test_a_landing_begins_at_its_mark() -> None:
    assert landing_start(OUT) is None
    assert landing_start((*OUT, *LANDING)) == 4
    assert landing_start((*OUT, LANDING[2])) == 4
    assert landing_start((LANDING[2], LANDING[0])) == 0


def test_with_a_landing_the_mission_is_flown_on_to_it() -> None:
    stored = plans(*OUT, *LANDING, at(50, 50, 5), current=2)
    way = along_mission(stored, ORIGIN, place(20, 10, 7), flying=True)
    wanted = ((16, 20, 20), (16, 0, 20), (16, -10, 20), (21, -10, 0))
    assert places(way) == pytest.approx(expected(*wanted))
    assert way[0].params[0] == 0.0  # no stay
    # A mission that is not being flown begins at the nearest item, height counted.
    near = along_mission(stored, ORIGIN, place(1, 19, 7), flying=False)
    assert places(near) == places(way[1:])
    # A mission past its landing continues with the next item.
    last = along_mission(stored, ORIGIN, place(50, 50, 5), flying=False)
    assert places(last) == expected((16, 50, 50))


def test_without_a_landing_it_is_flown_back_and_home() -> None:
    stored = plans(*OUT, current=3)
    way = along_mission(stored, ORIGIN, place(10, 20, 7), flying=True)
    wanted = ((16, 20, 20), (16, 20, 0), (16, 0, 0), (21, 0, 0))
    assert places(way) == pytest.approx(expected(*wanted))
    assert way[-1].z == ORIGIN.altitude_m
    first = along_mission(plans(*OUT), ORIGIN, place(5, 0, 5), flying=True)
    assert places(first) == expected((16, 0, 0), (21, 0, 0))
    assert along_mission(Plans(), ORIGIN, place(5, 0, 5), flying=False) == ()


def test_jumps_that_are_left_are_taken_and_endless_ones_end() -> None:
    stored = plans(at(10, 0, 5), do(_N.DO_JUMP, 0, 2), LANDING[2])
    stored.jumps_done[1] = 1
    assert [item.command for item in onwards(stored, 0)] == [16, 16, 21]
    assert stored.jumps_done == {1: 1}
    endless = plans(at(10, 0, 5), do(_N.DO_JUMP, 0, 60_000), LANDING[2])
    assert len(onwards(endless, 0)) <= 1_000


# --- flights


def flown_mission(rig: Rig, *items: PlanItem, current: int = 0) -> None:
    """Take off and fly a mission from an item on."""
    rig.take_off(6.0, settle_s=0.0)
    rig.ap.plans.store(MissionType.MISSION, items, 1, current)
    rig.run(0.3)
    assert rig.ap.set_mode(Mode.MISSION) is Result.ACCEPTED


def distances(rig: Rig, seconds: float, *goals: tuple[float, float]) -> list[float]:
    """Fly on; return how near the vehicle came to each place [m]."""
    nearest = [math.inf] * len(goals)

    def watch() -> None:
        north, east, _ = rig.truth.position
        for index, goal in enumerate(goals):
            nearest[index] = min(nearest[index], math.hypot(north - goal[0], east - goal[1]))

    rig.run(seconds, watch)
    return nearest


def test_a_return_goes_back_the_way_it_came() -> None:
    rig = Rig(parameters={"RTL_TYPE": 2, "MIS_TKO_LAND_REQ": 0})
    flown_mission(rig, TAKE_OFF, at(20, 0, 6), at(20, 20, 6), at(0, 30, 6), current=1)
    rig.until(lambda: rig.ap.plans.current == 3, 40.0)
    rig.run(3.0)  # until the waypoint before it lies behind
    assert rig.ap.set_mode(Mode.RETURN) is Result.ACCEPTED
    assert math.isnan(rig.said("RTL: start return"))
    rig.run(0.3)
    there = rig.ap.state().destination
    assert there is not None and there[:2] == pytest.approx((20.0, 20.0), abs=0.5)
    assert max(distances(rig, 22.0, (20.0, 20.0), (20.0, 0.0))) < 3.0
    rig.until(lambda: rig.ap.flight.phase < FlightPhase.AIR, 60.0)
    assert rig.truth.position[:2] == pytest.approx([0.0, 0.0], abs=1.0)
    rig.until(lambda: rig.ap.flight.phase < FlightPhase.GROUND, 5.0)
    rig.close()


def test_a_return_flies_on_to_the_missions_landing() -> None:
    rig = Rig(parameters={"RTL_TYPE": 2})
    items = (TAKE_OFF, at(15, 0, 6), at(15, 15, 6, _N.LOITER_TIME, 60.0))
    flown_mission(rig, *items, at(0, 15, 0, _N.LAND), current=1)
    rig.until(lambda: rig.ap.plans.current == 2, 40.0)
    # A failsafe's return takes the same way; the user's may interrupt it.
    rig.ap.set_mode(Mode.RETURN)
    assert distances(rig, 12.0, (15.0, 15.0))[0] < 3.0
    rig.ap.set_mode(Mode.HOLD)
    rig.run(1.0)
    rig.ap.set_mode(Mode.RETURN)
    rig.until(lambda: rig.ap.flight.phase < FlightPhase.AIR, 60.0)
    assert rig.truth.position[:2] == pytest.approx([0.0, 15.0], abs=1.0)
    rig.close()


def test_without_a_mission_it_stays_where_it_is() -> None:
    rig = Rig(parameters={"RTL_TYPE": 2})
    rig.take_off(6.0)
    rig.ap.set_mode(Mode.RETURN)
    rig.run(6.0)
    assert rig.said("No valid mission available, loitering") > 0.0
    assert rig.mode is Mode.RETURN
    assert rig.height == pytest.approx(6.0, abs=0.7)
    rig.close()


def test_the_missions_landing_is_flown_from_its_beginning() -> None:
    rig = Rig(parameters={"RTL_TYPE": 1, "RTL_RETURN_ALT": 12.0, "RTL_CONE_ANG": 0})
    landing = (do(_N.DO_LAND_START), at(20, 20, 10), at(20, 0, 0, _N.LAND))
    rig.take_off(6.0, settle_s=0.0)
    rig.ap.plans.store(MissionType.MISSION, (TAKE_OFF, *landing), 1, 0)
    rig.run(0.3)
    rig.ap.set_mode(Mode.RETURN)
    rig.run(0.2)
    assert rig.said("RTL Mission land: climb to") > 0.0
    rig.until(lambda: rig.height > 11.0, 20.0)
    assert math.hypot(*rig.truth.position[:2]) < 2.0
    assert distances(rig, 20.0, (20.0, 20.0))[0] < 3.0
    rig.until(lambda: rig.ap.flight.phase < FlightPhase.AIR, 60.0)
    assert rig.truth.position[:2] == pytest.approx([20.0, 0.0], abs=1.0)
    rig.close()
